"""Changes of a servo that swings a weight: labelled logs, cases drawn by seed, and how often they are found.

    python -m experiments.real.sts3215 FOLDER [--part judge] [--cases N] [--output FILE.json]

FOLDER has logs and an index.csv (file, mass, length, kp, trajectory, repeat, and motor if there are several).
A configuration is a combination of motor, mass, length and gain. Its model (experiments/real/servo.py) is
calibrated on all logs of one configuration, and changes are sought in those of another: none (second repeats
against first ones, or motions against other motions), mass, length, gain, or two of these at once. Many logs
contain single samples that no servo can have produced; `spurious` cases, in which nothing changed, get
PLANTED more of them, which must be found and must not become a cause. --part selects one half of the
configurations, split by the seed, so that methods developed on one half can be judged on the other; `mixed`
are changes from one half to the other.

What the equations can distinguish: at rest and in slow motion, gravity gives m l alone. In fast motion the
inertia m l^2 + J adds to it, with J the rotor's. Let m l grow by a factor r. By a change of mass, m l^2 grows
by r; by a change of length, by r^2. The two differ by m l^2 (r^2 - r) out of J + m l^2 r; if that is less
than TOLD, to which J itself is known, mass and length are rightly a set. Only the gain changes the recorded
duty for a given error, so it is identified alone.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from experiments.real.servo import Servo
from experiments.saving import save
from simgap.robot_effects import effects_of
from simgap.robots.calibrate import Calibration, calibrate
from simgap.robots.changes import Changes, changes
from simgap.robots.unchanged import Old, without_broken
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

TOLD = 0.1  # chosen: share of the inertia that can be resolved; the rotor's is known to some 5 %
ROTOR = 0.0275  # cited: kg m^2; fits of this servo by Rhoban/bam's users, 0.027 to 0.028
SIGN = 10.24  # data sheet: bit 10 of the load register is the direction; units of a hundredth
SPURIOUS = -3.14  # rad; value of a failed reading on the bench
PLANTED = 3  # chosen: spurious samples, each in another log
FEW = 10  # logs of a configuration that a case takes at most
GOAL = ">= 97 %"
KINDS = ("repeats", "motions", "spurious", "mass", "length", "kp", "two")
UNCHANGED = ("repeats", "motions", "spurious")
SHOWN = ("mass", "length", "kp")
EFFECT = {"mass": "mass", "length": "length", "kp": "gain"}


@dataclass(frozen=True)
class Case:
    """Logs of `old` and `new` by file; `truth`: what differs, with its ratio."""

    kind: str
    old: tuple[str, ...]
    new: tuple[str, ...]
    stated: tuple[float, float, float]  # mass [kg], length [m], register of the old
    truth: dict[str, float]
    alone: bool  # whether the equations distinguish it from all others
    between: tuple[Any, Any]  # the configurations


def read(path: Path) -> Recording:
    """A log: angle, duty with its sign, goal, supply, whether the drive is on."""
    d = pd.read_csv(path)
    load = d["torque"].to_numpy(float)
    columns = {
        "position": d["position"].to_numpy(float),
        "duty": np.where(load >= SIGN, load - SIGN, -load) / 10,
        "goal": d["goal_position"].to_numpy(float),
        "volts": d["input_volts"].to_numpy(float),
        "on": d["torque_enable"].to_numpy(float),
    }
    return Recording(path.name, d["t"].to_numpy(float), columns)


def configurations(index: pd.DataFrame, part: str, seed: int) -> list[tuple[Any, pd.DataFrame]]:
    """Logs by motor, mass, length and gain, optionally of one half of the configurations."""
    keys = [k for k in ("motor", *SHOWN) if k in index]
    every = list(index.groupby(keys, sort=True))
    order = np.random.default_rng(seed).permutation(len(every))
    half = {"develop": order[::2], "judge": order[1::2], "mixed": order, "all": order}[part]
    return [every[k] for k in sorted(half)]


def drawn(index: pd.DataFrame, part: str, count: int, seed: int) -> list[Case]:
    """Draw `count` cases of every kind."""
    rng = np.random.default_rng([seed, 1])
    groups = configurations(index, part, seed)
    half = [key for key, _ in configurations(index, "develop", seed)]
    out: list[Case] = []
    for kind in KINDS:
        made = [] if part == "mixed" and kind in UNCHANGED else _made(kind, groups, rng)
        if part == "mixed":
            made = [c for c in made if (c.between[0] in half) != (c.between[1] in half)]
        most = max(1, count // 2) if kind in ("two", "spurious") else count
        out += [made[k] for k in rng.permutation(len(made))[:most]]
    return out


def _made(kind: str, groups: Sequence[tuple[Any, pd.DataFrame]], rng: np.random.Generator) -> list[Case]:
    out = []
    if kind in UNCHANGED:
        for key, logs in groups:
            by = "trajectory" if kind == "motions" else "repeat"
            for _ in range(2):
                values = rng.permutation(np.unique(logs[by]))
                half = values[: (len(values) + 1) // 2]
                if len(half) < len(values):
                    old, new = logs[logs[by].isin(half)], logs[~logs[by].isin(half)]
                    out.append(_case(kind, key, key, old, new, rng))
        return out
    for (one, a), (two, b) in itertools.permutations(groups, 2):
        differ = [n for n, x, y in zip(SHOWN, one[-3:], two[-3:], strict=True) if x != y]
        same_motor = one[:-3] == two[:-3]
        if same_motor and (differ == [kind] or (kind == "two" and len(differ) == 2)):
            out.append(_case(kind, one, two, a, b, rng))
    return out


def _case(
    kind: str, one: Any, two: Any, old: pd.DataFrame, new: pd.DataFrame, rng: np.random.Generator
) -> Case:
    stated, now = [tuple(float(x) for x in key[-3:]) for key in (one, two)]
    truth = {EFFECT[n]: y / x for n, x, y in zip(SHOWN, stated, now, strict=True) if x != y}
    own = np.random.default_rng(0)  # OLD's logs are the same in all cases, and calibrated on once
    files = [tuple(g["file"].iloc[np.sort(r.permutation(len(g))[:FEW])]) for g, r in ((old, own), (new, rng))]
    return Case(kind, files[0], files[1], stated, truth, told_alone(stated, truth), (one, two))


def told_alone(stated: tuple[float, float, float], truth: dict[str, float]) -> bool:
    """Whether the equations distinguish a change from any other (see above)."""
    mass, length, _ = stated
    if len(truth) != 1 or "gain" in truth:
        return len(truth) == 1
    (r,) = truth.values()
    inertia = mass * length**2
    now = inertia * r ** (2 if "length" in truth else 1)
    return abs(inertia * (r**2 - r)) / (ROTOR + now) > TOLD


def planted(logs: Sequence[Recording]) -> list[Recording]:
    """Plant a spurious angle in each of some logs, as the bench's reader produces them."""
    rng, out = np.random.default_rng(0), list(logs)
    for k in rng.permutation(len(out))[:PLANTED]:
        angle = out[k]["position"].copy()
        angle[rng.integers(20, angle.size - 20)] = SPURIOUS
        out[k] = out[k].with_columns({"position": angle})
    return out


def solved(
    case: Case, folder: Path, known: dict[Any, tuple[Calibration, Old | None]]
) -> tuple[Changes, float]:
    """What is found, and the processor's seconds."""
    begun = time.process_time()
    servo = checked(Servo(*case.stated), "servo.py:Servo")
    old, new = ([read(folder / f) for f in files] for files in (case.old, case.new))
    if case.kind == "spurious":
        new = planted(new)
    effects = effects_of(servo, old)
    key = (case.old, case.stated)
    if key not in known:
        known[key] = calibrate(servo, without_broken(servo, old)[0], effects), None
    calibration, before = known[key]
    found = changes(servo, old, new, effects, calibration=calibration, known=before)
    known[key] = calibration, found.old
    return found, time.process_time() - begun


def scored(case: Case, found: Changes) -> dict[str, Any]:
    """How a case was answered."""
    told = found.sizes()
    named = set(found.best.effects) if found.verdict != "none" else set()
    members = [named, *(set(c.effects) for c in found.others)]
    right = set(case.truth)
    out: dict[str, Any] = {
        "kind": case.kind, "truth": case.truth, "stated": case.stated, "alone": case.alone,
        "verdict": found.verdict, "named": sorted(named), "others": [sorted(c.effects) for c in found.others],
        "over": found.over, "broken": len(found.broken), "worse": found.worse, "between": case.between,
        "spurious": sum(b.channel == "position" and b.value == SPURIOUS for b in found.broken),
        "none": found.verdict == "none",
        "in_set": found.verdict in ("named", "set") and any(right == m for m in members),
        "any": found.verdict in ("named", "set") and bool(right & set().union(*members)),
        "held": found.verdict in ("named", "set") and right <= set().union(*members),
        "is_alone": found.verdict == "named" and named == right,
        "sizes": {},
    }  # fmt: skip
    explanation = next((c for c in found.tried if set(c.effects) == right), None)
    if explanation is not None and right:
        told = found.sizes(explanation)
        for name, ratio in case.truth.items():
            one = told[name]
            low, high = one["ratio_90"]
            out["sizes"][name] = {
                "ratio": one["ratio"], "interval": [low, high], "true": ratio,
                "off": one["ratio"] / ratio - 1, "holds": low <= ratio <= high,
            }  # fmt: skip
    return out


def summary(cases: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Hits, number and 90 % interval (Clopper and Pearson) of every figure."""
    nothing = [c for c in cases if not c["truth"]]
    changed = [c for c in cases if c["truth"]]
    sizes = {n: [c["sizes"][n] for c in changed if n in c["sizes"]] for n in ("mass", "gain", "length")}
    gains = [c for c in cases if c["kind"] == "kp"]
    asked = (
        ("nothing changed: none", [c["none"] for c in nothing], GOAL),
        *(
            (f"the same, {words}", [c["none"] for c in nothing if c["kind"] == kind], "")
            for kind, words in (("repeats", "other repeats"), ("motions", "other motions"))
        ),
        (f"{PLANTED} spurious samples planted: found, and none", [
            c["none"] and c["spurious"] >= PLANTED for c in nothing if c["kind"] == "spurious"
        ], ""),
        ("one change: named or in the set", [c["in_set"] for c in changed if c["kind"] != "two"], ">= 95 %"),
        ("two changes: both named, or a set with both", [
            c["in_set"] for c in changed if c["kind"] == "two"
        ], ""),
        ("two changes: at least one named or in the set, or unknown", [
            c["verdict"] == "unknown" or c["any"] for c in changed if c["kind"] == "two"
        ], ""),
        ("named alone where told so", [c["is_alone"] for c in changed if c["alone"]], ">= 80 %"),
        ("mass, where it was sought: within 5 %", [abs(s["off"]) <= 0.05 for s in sizes["mass"]], ""),
        ("90 % interval holds the mass", [s["holds"] for s in sizes["mass"]], "85 to 95 %"),
        ("gain: named, ratio within 5 %", [
            c["is_alone"] and abs(c["sizes"]["gain"]["off"]) <= 0.05 for c in gains
        ], ">= 95 %"),
        ("90 % interval holds the gain", [s["holds"] for s in sizes["gain"]], ""),
        ("90 % interval holds the length", [s["holds"] for s in sizes["length"]], ""),
    )  # fmt: skip
    out = []
    for label, hits, goal in asked:
        if hits:
            interval = binomtest(sum(hits), len(hits)).proportion_ci(0.9)
            out.append({"figure": label, "hits": sum(hits), "of": len(hits), "goal": goal,
                        "interval_90": [float(interval.low), float(interval.high)]})  # fmt: skip
    return out


def main() -> None:
    """Draw, solve, score and save."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", choices=("develop", "judge", "mixed", "all"), default="all")
    parser.add_argument("--cases", type=int, default=24, help="of every kind, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    index = pd.read_csv(given.folder / "index.csv")
    known: dict[Any, tuple[Calibration, Old | None]] = {}
    out = []
    for case in drawn(index, given.part, given.cases, given.seed):
        found, seconds = solved(case, given.folder, known)
        one = scored(case, found) | {"seconds": seconds, "truth_text": _text(case.truth)}
        out.append(one)
        print(*_row(one).values(), sep=" | ", flush=True)
        if given.output is not None:
            settings = {"part": given.part, "seed": given.seed, "drawn": given.cases}
            save(given.output, {**settings, "figures": summary(out), "cases": out})
    for figure in summary(out):
        low, high = figure["interval_90"]
        hits = f"{figure['hits']} of {figure['of']} ({low:.2f} to {high:.2f})"
        print(f"{figure['figure']}: {hits} {figure['goal']}")


def _text(ratios: dict[str, float]) -> str:
    return " ".join(f"{n} x{r:.3g}" for n, r in ratios.items()) or "nothing"


def _row(one: dict[str, Any]) -> dict[str, Any]:
    """A line for people."""
    sizes = [
        f"{n} x{s['ratio']:.3f} ({s['interval'][0]:.3f} to {s['interval'][1]:.3f})"
        for n, s in one["sizes"].items()
    ]
    return {
        "kind": one["kind"], "old": "/".join(f"{v:g}" for v in one["stated"]), "truth": one["truth_text"],
        "told alone": one["alone"], "verdict": one["verdict"], "named": "+".join(one["named"]),
        "others": " ".join("+".join(o) for o in one["others"]), "size of the truth": "; ".join(sizes),
        "over": round(one["over"], 2), "p unknown": round(one["worse"], 4), "broken": one["broken"],
        "seconds": round(one["seconds"], 1),
    }  # fmt: skip


if __name__ == "__main__":
    main()
