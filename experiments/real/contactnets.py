"""Real tosses of a cube against MuJoCo's model of it with the published parameters.

    python -m experiments.real.contactnets FOLDER [--output FILE.json] [--figures DIR] [--drawn]

FOLDER holds tosses.csv and source_params.json (DAIRLab/contact-nets). Every toss is a log of the cube's pose;
the model is built from the published mass, side, friction and inertia. TOSSES of them, evenly chosen, are
taken, without the SEEN ones on which the settings of the method were chosen.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.real.robot_gap import RESULTS, asked, published
from experiments.saving import save
from simgap.robot_effects import candidates
from simgap.robot_effects.base import RobotEffect, Setting
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.mjcf.load import load_mjcf
from simgap.simulators.recording import Recording

SEEN, TOSSES = 16, 20
GRAVITY, CLEAR = 9.81, 3e-3  # m/s^2 as published; m
FEWEST, LAST = 10, 10  # frames
SOURCE_UNIT = 0.0524  # m: half of the published side
POSE = {"x": "x", "y": "y", "z": "z", "qw": "qw", "qx": "qx", "qy": "qy", "qz": "qz"}


def model_text(params: dict) -> str:
    """The cube on a board, as MJCF, by the published parameters (given in units of SOURCE_UNIT)."""
    half = SOURCE_UNIT
    inertia = params["inertia"] * SOURCE_UNIT**2
    return f"""<mujoco model="cube">
  <option timestep="0.0016891892" integrator="implicitfast" cone="elliptic" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="board" type="plane" size="2 2 0.1" friction="{params["mu"]} 0.005 0.0001"/>
    <body name="cube">
      <freejoint name="pose"/>
      <inertial pos="0 0 0" mass="{params["mass"]}" diaginertia="{inertia:.6g} {inertia:.6g} {inertia:.6g}"/>
      <geom name="box" type="box" size="{half} {half} {half}" friction="{params["mu"]} 0.005 0.0001"/>
    </body>
  </worldbody>
</mujoco>
"""


def map_text() -> str:
    """Which column is which component of the cube's pose."""
    return "window = 0.2\n" + "".join(
        f'[columns.{c}]\nbody = "cube"\naxis = "{a}"\n' for c, a in POSE.items()
    )


def write_inputs(folder: Path, into: Path, count: int = TOSSES) -> list[Path]:
    """Model, map and one CSV a toss in `into`; paths of the tosses."""
    params = json.loads((folder / "source_params.json").read_text(encoding="utf-8"))
    (into / "cube.xml").write_text(model_text(params), encoding="utf-8")
    (into / "map.toml").write_text(map_text(), encoding="utf-8")
    tosses: Any = pd.read_csv(folder / "tosses.csv")
    numbers = np.unique(tosses.toss)
    numbers = np.setdiff1d(numbers, evenly(numbers, SEEN))
    out = []
    for number in evenly(numbers, count):
        path = into / f"toss_{number:03d}.csv"
        tosses[tosses.toss == number][["t", *POSE]].to_csv(path, index=False)
        out.append(path)
    return out


def evenly(values: np.ndarray, count: int) -> np.ndarray:
    """At most so many of the values (n,), evenly chosen."""
    return values[np.linspace(0, values.size - 1, min(count, values.size)).round().astype(int)]


def by_hand(folder: Path) -> dict[str, dict[str, float]]:
    """What flight and rest tell of all tosses by themselves, with no model but a parabola and the published
    side.

    Of each toss the vertical acceleration before its lowest corner comes within CLEAR of the board, and the
    mean height of its last samples; means, and standard errors over tosses, as shares of what is published.
    """
    from scipy.spatial.transform import Rotation

    tosses: Any = pd.read_csv(folder / "tosses.csv")
    corner = SOURCE_UNIT * np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    gravity, height = [], []
    for _, toss in tosses.groupby("toss"):
        turn = Rotation.from_quat(toss[["qx", "qy", "qz", "qw"]].to_numpy())
        z, t = toss.z.to_numpy(), toss.t.to_numpy()
        lowest = z + np.array([turn.apply(c)[:, 2] for c in corner]).min(0)
        flies = int(np.argmax(lowest < CLEAR)) if (lowest < CLEAR).any() else z.size
        if flies >= FEWEST:
            gravity.append(-2 * np.polyfit(t[:flies], z[:flies], 2)[0] / GRAVITY - 1)
        height.append(z[-LAST:].mean() / SOURCE_UNIT - 1)
    return {n: _mean(v) for n, v in (("flight", gravity), ("rest", height))}


def _mean(values: list[float]) -> dict[str, float]:
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return {"tosses": len(values), "off": round(float(np.mean(values)), 5), "error": round(float(error), 5)}


def draw(folder: Path, scale: float, path: Path, count: int = TOSSES) -> None:
    """Heights against the model's in flight and at rest, as published and with positions read on a scale."""
    from hmmseg.plot.style import BLUE, RED, canvas
    from simgap.robots.linear import base_at
    from simgap.robots.model import Composed
    from simgap.robots.rows import noises
    from simgap.robots.windows import FLIES, RESTS

    with tempfile.TemporaryDirectory() as into:
        loaded, logs, more = read(folder, Path(into), count)
    simulator = loaded.simulator
    effects = candidates(Setting(simulator, logs)) | {e.name: e for e in more}
    length = loaded.map.length
    composed = Composed.of(simulator, logs, effects, noises(simulator, logs), length).calm()
    rows, z = composed.rows, list(composed.rows.channels).index("z")
    points = (
        ({}, RED, "as published"),
        ({"readout.scale": {"scale": scale}}, BLUE, f"scale {100 * scale:.2f} %"),
    )
    with canvas(path, height=2.8) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for point, colour, label in points:
            off = 1e3 * (rows.observed - base_at(composed, point).rows)
            for window, mine in zip(composed.windows, rows.of, strict=True):
                here = np.arange(mine.start, mine.stop)[rows.channel[mine] == z]
                panel = panels[(FLIES, RESTS).index(window.regime)]
                panel.plot(1e3 * rows.since[here], off[here], color=colour, lw=0.7, label=label)
                label = None
        for panel, title in zip(panels, ("flight", "rest"), strict=True):
            panel.set(xlabel="time since the window's start [ms]", title=title)
        panels[0].set_ylabel("height, recorded less simulated [mm]")
        panels[0].legend(fontsize=6.5)


def read(folder: Path, into: Path, count: int) -> tuple[Any, list[Recording], list[RobotEffect]]:
    """The model, the logs and the candidates that need the model."""
    paths = write_inputs(folder, into, count)
    loaded = load_mjcf(into / "cube.xml", into / "map.toml")
    logs = [loaded.read(p) for p in paths]
    return loaded, logs, loaded.effects(logs)


def run(folder: Path, count: int = TOSSES) -> RobotDiagnosis:
    """The diagnosis of the tosses."""
    with tempfile.TemporaryDirectory() as into:
        loaded, logs, more = read(folder, Path(into), count)
    return diagnose(loaded.simulator, logs, more=more, tell=print, length=loaded.map.length)


def main() -> None:
    """Run on a folder and write the results; with figures, `by_hand` too."""
    given = asked(__doc__ or "")
    output = given.output or RESULTS / "contactnets.json"
    if not (given.drawn and output.exists()):
        published(run(given.folder), "contactnets", output, None)
    save(output.with_name("contactnets_by_hand.json"), by_hand(given.folder))
    if given.figures is not None:
        found = json.loads(output.read_text(encoding="utf-8"))
        scale = found["effects"]["readout.scale"]["parameters"]["scale"]["mean"]
        draw(given.folder, scale, given.figures / "contactnets.png")


if __name__ == "__main__":
    main()
