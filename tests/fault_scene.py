"""A healthy recording of two fingers, and what a line about a faulty one makes of its rig."""

import re
import tomllib
from pathlib import Path

from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig, parse_rig, read_rig

FOLDER = Path(__file__).resolve().parents[1] / "recordings/none_1"
JOINTED = read_rig(FOLDER / "rig.toml")
JOINT = {name: values for name, values in [
    (name, values) for trial in [read_trial(FOLDER / "trial_01.csv", JOINTED)]
    for name, values in [("t", trial.t), *trial.channels.items()]]}  # fmt: skip
_SIGNALS = task_space(read_trial(FOLDER / "trial_01.csv", JOINTED), JOINTED)
CARTESIAN = {name: getattr(_SIGNALS, name) for name in (
    "t", "x1", "y1", "vx1", "vy1", "fx1", "fy1", "x2", "y2", "vx2", "vy2", "fx2", "fy2")}  # fmt: skip
FREE = parse_rig({})


def mended(rig: Rig, line: str) -> Rig:
    """The rig with the entries that a line proposes, read as TOML."""
    proposed = line.rsplit("; expected ", 1)[-1].rsplit("; ", 1)[-1]
    proposed = proposed.removeprefix("for times from 0, ").removesuffix(" under [columns] in rig.toml")
    entries = re.findall(r'\w+ = (?:\{[^}]*\}|"[^"]*")', re.sub(r' \(or "cm"\)', "", proposed))
    table = tomllib.loads("\n".join(entries))
    return rig.model_copy(update={"columns": parse_rig({"columns": table}).columns})
