"""An arm reaches, lowers and pushes a cube: where a model of it parts from the real one, and why.

    python -m experiments.real.collins_push FOLDER [--figures DIR] [--only hand|cube|together|free]
    python -m experiments.real.collins_push FOLDER --prepare DIR

FOLDER holds cubepush (Collins, Howard, Leitner). The hand's diagnosis against the authors' arm
(experiments/real/collins_hand.py), and what held-out trials say of the cube in the way of the recorded hand
(experiments/real/collins_cube.py). Together, open loop: the cube in the way of the hand that the arm would
have, each trial by what the others tell. Writes experiments/results/collins_hand.json, collins_cube.json and
collins_push.json, the last with four engines' recordings beside the real ones; `free` asks for the hand's
cause with all candidates (collins_hand_free.json).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from experiments.real import collins_cube, collins_hand
from experiments.real.collins_arm import POSE, prepared
from experiments.real.collins_cube import CUBE, Cube
from experiments.real.collins_engines import beside
from experiments.real.hiro_gap import rounded
from experiments.real.robot_gap import RESULTS, summary
from experiments.saving import ROOT, save
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.recording import Recording, read_recording
from simgap.simulators.user import UserSimulator, checked

WORK = ROOT / "build" / "collins_push.npz"  # courses of hands, from one part to the next
ASKED = ("gravity_compensation",)  # what two joints of the same arm were named for (collins_twojoint.json)
DRAWN = 6  # number of the trial that the figure shows
BAR = ("finger.along", "finger.up")
SIZE = np.array([2e-3] * 3 + [5e-3] * 4)  # m and 1: differences of the cube's pose that count alike
STEP, FITS = 0.05, 10  # of a usual size: a finite difference, for what tips is not smooth; evaluations
CAME = {"table.friction": 1.0, "finger.friction": 1.0}  # as in the authors' model


def hand(folder: Path, forced: Sequence[str] = ASKED) -> RobotDiagnosis:
    """The hand's diagnosis, phases by name; `forced`: with these causes, all that act if there are none."""
    simulator = checked(collins_hand.Hand(), "hand")
    with tempfile.TemporaryDirectory() as into:
        logs = [read_recording(p, simulator.channels) for p in collins_hand.prepare(folder, Path(into))]
    return diagnose(simulator, logs, forced=forced, phases=collins_hand.phases(logs), tell=print)


def cube(folder: Path) -> dict[str, Any]:
    """What held-out trials say of the cube, its hand as it was recorded: each half of the trials by what the
    other tells, with nothing fitted but where the bar is (`as it came`), the frictions too, and one more.

    Root mean square of its pose by channel and of the end of its way; mean square in units of SIZE."""
    with tempfile.TemporaryDirectory() as into:
        paths, courses = collins_cube.prepare(folder, Path(into))
        simulator = checked(Cube(courses), "cube")
        logs = [read_recording(p, simulator.channels) for p in paths]
    sets = {"as it came": BAR, "frictions": (*BAR, *CAME)}
    known = [n for n, p in simulator.parameters.items() if not p.fitted]
    sets |= {n: (*BAR, *CAME, n) for n in known if "contact" not in n}
    sets["contact"] = (*BAR, *CAME, *(n for n in known if "contact" in n))
    out: dict[str, Any] = {}
    for name, free in sets.items():
        left: list = [None] * len(logs)
        for part in (0, 1):
            found = _fit(simulator, logs[part::2], free)
            for k in range(1 - part, len(logs), 2):
                left[k] = _off(simulator, logs[k], found)
        off = np.array(left)
        rms = np.sqrt(np.mean(off**2, (0, 2)))
        out[name] = {
            "square": float(np.mean((off / SIZE[:, None]) ** 2)),
            "rms": dict(zip(CUBE.values(), rms.tolist(), strict=True)),
            "end_mm": (1e3 * np.sqrt(np.mean(off[:, :3, -1] ** 2, 0))).tolist(),
        }
        print(name, out[name]["square"], flush=True)
    last = _fit(simulator, logs, sets["frictions"])
    done: Any = rounded({"sets": out, "fitted": {n: last[n] for n in sets["frictions"]}})
    return done


def _off(simulator: UserSimulator, log: Recording, values: dict[str, float]) -> np.ndarray:
    """Simulated less recorded (7, n)."""
    out = simulator.simulate(values, log)
    return np.array([out[n] - log[n] for n in CUBE.values()])


def _fit(simulator: UserSimulator, logs: Sequence[Recording], free: Sequence[str]) -> dict[str, float]:
    """Values of all parameters: the `free` ones by least squares with their priors, others as they are."""
    known = [simulator.parameters[n] for n in free]
    nominal, sd = (np.array([getattr(p, a) for p in known]) for a in ("nominal", "sd"))
    base = {n: p.nominal for n, p in simulator.parameters.items()}
    base |= {} if set(CAME) <= set(free) else CAME

    def values(x: np.ndarray) -> dict[str, float]:
        return base | dict(zip(free, (nominal + sd * x).tolist(), strict=True))

    def cost(x: np.ndarray) -> np.ndarray:
        off = [_off(simulator, log, values(x)) / SIZE[:, None] for log in logs]
        return np.append(np.concatenate([o.ravel() for o in off]), x)

    bounds = [(np.array([getattr(p, a) for p in known]) - nominal) / sd for a in ("low", "high")]
    lower, upper = np.minimum(bounds[0], -1e-6), np.maximum(bounds[1], 1e-6)

    def slope(x: np.ndarray) -> np.ndarray:
        here = cost(x)
        return np.array([(cost(x + STEP * e) - here) / STEP for e in np.eye(x.size)]).T

    derivative: Any = slope
    found = least_squares(cost, 0.0 * nominal, derivative, bounds=(lower, upper), max_nfev=FITS)
    return values(found.x)


def told(found: RobotDiagnosis) -> dict[str, Any]:
    """The summary, where the gap lies (shares by phase and channel, of all trials and bands), and what no
    verdict rests on: root mean squares by phase and channel, as the model came and with all that was borne
    out."""
    where: dict[str, dict[str, float]] = {n: {} for n in found.phases.names}
    for cell in found.verdict.where:
        where[cell.part][cell.channel] = where[cell.part].get(cell.channel, 0.0) + cell.share
    rows, phase = found.composed.rows, found.phases.of(found.composed.rows)
    left = {
        name: {
            channel: [
                float(np.sqrt(np.nanmean(r[(phase == k) & (rows.channel == c)] ** 2)))
                for r in (found.plain.residual, found.linear.residual)
            ]
            for c, channel in enumerate(rows.channels)
        }
        for k, name in enumerate(found.phases.names)
        if (phase == k).any()
    }
    borne = list(found.verdict.explanation)
    point = {n: dict(at) for n, at in found.linear.point.items() if not n.startswith("log.")}
    more: Any = rounded({"where": where, "rms_fitted": left, "borne_out": borne, "point": point})
    return summary(found) | more


def predicted(found: RobotDiagnosis) -> dict[str, np.ndarray]:
    """Of each trial (k) times (k, n) and the hand's poses (k, 7, n): `recorded`, and by what the other trials
    tell `before` and `after`."""
    rows, far = found.composed.rows, found.shrinkage
    left = (found.plain.residual, found.linear.residual) if far is None else (far.plain, far.residual)
    order = [rows.channels.index(c) for c in POSE.values()]
    grid = np.array([np.flatnonzero(rows.log == k) for k in range(len(found.composed.recordings))])
    grid = grid.reshape(len(grid), -1, len(rows.channels))
    out = {"t": rows.time[grid[:, :, 0]]}
    for name, off in zip(("recorded", "before", "after"), (0.0, *left), strict=True):
        pose = (rows.observed - off)[grid].transpose(0, 2, 1)[:, order]
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        out[name] = pose
    return out


def pushed(folder: Path, courses: Any, fitted: dict[str, float]) -> dict[str, np.ndarray]:
    """Of each trial (k) the cube's poses (k, 7, n) at the courses' times: `recorded`, and of a cube in the
    way of the hand `before` (with the authors' frictions) and `after`; at the values that were `fitted`."""
    nominal = {n: p["nominal"] for n, p in Cube.parameters.items()} | fitted
    out: dict[str, list] = {n: [] for n in ("recorded", "before", "after")}
    with tempfile.TemporaryDirectory() as into:
        columns = list(CUBE.values())
        paths = prepared(folder / "cubepush" / "real", Path(into), columns, collins_hand.RATE)
        frames: list[Any] = [pd.read_csv(p) for p in paths]
    for k, frame in enumerate(frames):
        t = courses["t"][k]
        seen = np.array([np.interp(t, frame.t, frame[c]) for c in columns])
        out["recorded"].append(seen)
        log = Recording("trial", t, dict(zip(columns, seen, strict=True)))
        for name, values in (("before", nominal | CAME), ("after", nominal)):
            hand_link = collins_cube.link(t, courses[name][k])
            run = Cube({"trial": (t, hand_link)}).simulate(values, log)
            out[name].append(np.array([run[c] for c in columns]))
    return {n: np.array(v) for n, v in out.items()}


def ends(cubes: dict[str, np.ndarray]) -> dict[str, Any]:
    """How far the cube is moved [mm] and turned [deg], by trial; root mean square error of where it ends."""
    out: dict[str, Any] = {}
    for name, pose in cubes.items():
        moved = 1e3 * (pose[:, :3, -1] - pose[:, :3, 0])
        same = np.abs(np.sum(pose[:, 3:, 0] * pose[:, 3:, -1], 1))
        turned = np.degrees(2 * np.arccos(np.minimum(same, 1.0)))
        off = 1e3 * (pose[:, :3, -1] - cubes["recorded"][:, :3, -1])
        out[name] = {
            "moved_mm": moved.round(1).tolist(),
            "turned_deg": turned.round(1).tolist(),
            "rms_mm": np.sqrt(np.mean(off**2, 0)).round(1).tolist(),
        }
    real = np.array(out["recorded"]["moved_mm"])
    for name in ("before", "after"):
        with np.errstate(invalid="ignore"):
            along = np.corrcoef(np.array(out[name]["moved_mm"])[:, 0], real[:, 0])[0, 1]
        out[name]["along_with_recorded"] = round(float(np.nan_to_num(along)), 2)
    out["recorded"]["sd_mm"] = real.std(0, ddof=1).round(1).tolist()
    return out


def draw(hands: Any, cubes: dict[str, np.ndarray], path: Path) -> None:
    """One trial, by what the others tell: the hand's height, the cube's way and height."""
    from hmmseg.plot.style import BLUE, GREY, INK, RED, canvas

    k, t = DRAWN, hands["t"][DRAWN]
    began = collins_hand.left(t, hands["recorded"][k][:3])
    lines = (("before", RED, "the model as it came"), ("after", BLUE, "with the causes"))
    shown = (
        (hands, 2, 1e3, "hand's height [mm]"),
        (cubes, 0, 1e3, "cube, x [mm]"),
        (cubes, 2, 1e3, "cube, z [mm]"),
    )
    with canvas(path, height=4.6) as figure:
        panels = figure.subplots(len(shown), 1, sharex=True)
        for axes, (poses, axis, unit, label) in zip(panels, shown, strict=True):
            axes.plot(t, unit * poses["recorded"][k][axis], color=INK, lw=1.2, label="recorded")
            for name, colour, text in lines:
                axes.plot(t, unit * poses[name][k][axis], color=colour, lw=0.9, label=text)
            for phase, begin in zip(collins_hand.PHASES, collins_hand.BEGINS, strict=True):
                axes.axvline(began + begin, color=GREY, lw=0.6, ls=":")
                if axes is panels[0]:
                    axes.text(
                        began + begin + 0.1, 1.02, phase, transform=axes.get_xaxis_transform(), fontsize=7
                    )
            axes.set_ylabel(label)
        panels[0].legend(fontsize=6.5)
        panels[-1].set_xlabel("time [s]")


def together(folder: Path, figures: Path | None) -> dict[str, Any]:
    """Hand and cube in one, by trial, and the engines; a figure in a folder."""
    courses = np.load(WORK)
    fitted = json.loads((RESULTS / "collins_cube.json").read_text(encoding="utf-8"))["fitted"]
    cubes = pushed(folder, courses, fitted)
    if figures is not None:
        draw(courses, cubes, figures / "collins_push.png")
    return {"ends": ends(cubes), "engines": beside(folder)}


def main() -> None:
    """Run on a folder and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--prepare", type=Path, metavar="DIR", help="write the hand's logs and stop")
    parser.add_argument("--only", choices=("hand", "cube", "together", "free"), help="one part of it")
    parser.add_argument("--figures", type=Path, help="folder that the figure goes to, such as docs/figures")
    given = parser.parse_args()
    if given.prepare is not None:
        given.prepare.mkdir(parents=True, exist_ok=True)
        collins_hand.prepare(given.folder, given.prepare)
        return
    if given.only in (None, "cube"):
        save(RESULTS / "collins_cube.json", cube(given.folder))
    if given.only in (None, "hand"):
        found = hand(given.folder)
        save(RESULTS / "collins_hand.json", told(found))
        WORK.parent.mkdir(exist_ok=True)
        np.savez(WORK, allow_pickle=False, **predicted(found))
    if given.only == "free":
        save(RESULTS / "collins_hand_free.json", told(hand(given.folder, ())))
    if given.only in (None, "together"):
        save(RESULTS / "collins_push.json", together(given.folder, given.figures))


if __name__ == "__main__":
    main()
