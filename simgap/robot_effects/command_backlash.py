"""Play between drive and joint: the command moves a dead band before it acts."""

from __future__ import annotations

import numpy as np

from hmmseg.online.compiled import compiled
from simgap.robot_effects.base import RobotEffect, Setting, places


@compiled
def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only where that pushes a side of the gap."""
    out = np.empty_like(values)
    at = values[0]
    for i in range(values.size):
        if np.isfinite(values[i]):
            at = min(max(at, values[i] - width / 2), values[i] + width / 2)
        out[i] = at
    return out


WORDS = {
    "command.backlash": (
        "play between a drive and what it moves",
        "Hold the drive still and move the joint by hand.",
    ),
}


def _played(name: str):
    return lambda recording, theta: recording.with_columns({name: play(recording[name], theta["width"])})


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command of a position."""
    return [
        RobotEffect(
            f"command:{name}.backlash",
            "acted follows commanded through a gap of this width",
            {"width": setting.usual(name, 0.02, low=0.0)},
            command=_played(name),
        )
        for name in places(setting)
    ]
