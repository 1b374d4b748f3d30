"""MuJoCo, whose bindings have no types for a checker; its warnings are counted."""

import importlib
from collections import Counter
from typing import Any

from hmmseg.errors import InputError

try:
    mujoco: Any = importlib.import_module("mujoco")
    rollout: Any = importlib.import_module("mujoco.rollout")
except ImportError:
    raise InputError("--mjcf", "needs MuJoCo", 'pip install "hmmseg[mujoco]"') from None
if mujoco.__version__ == "4.0.0":
    raise InputError("--mjcf", "MuJoCo 4.0.0 has a solver bug", "another version from 3 on")

FREE, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "SLIDE", "HINGE"))
JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)  # what an actuator moves
FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)

_WARNED: Counter[str] = Counter()


def _count(text: str | bytes) -> None:
    """Count a warning; MuJoCo itself would print each and write a file into the current folder."""
    line = text.decode(errors="replace") if isinstance(text, bytes) else text
    _WARNED[line.split(" Time = ")[0].strip().rstrip(".")] += 1


mujoco.set_mju_user_warning(_count)


def warned() -> list[str]:
    """MuJoCo's warnings since the last call, each once with its count."""
    found = [f"MuJoCo: {text} ({count} times)" for text, count in _WARNED.most_common()]
    _WARNED.clear()
    return found
