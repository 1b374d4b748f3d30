"""A drive that gives no more than so much."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, drives, places
from simgap.simulators.protocol import Parameter

WORDS = {
    "command.saturation": (
        "a drive that gives no more than so much",
        "Look up the drive's current limit; command its largest torque and measure it.",
    ),
}


def _limited(name: str, most: float):
    def act(recording, theta):
        limit = (1 - theta["lost"]) * most
        return recording.with_columns({name: np.clip(recording[name], -limit, limit)})

    return act


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command; `lost` is the share of the largest command that is never acted."""
    out = []
    for name in (*drives(setting), *places(setting)):
        most = setting.largest(name)
        if most > 0:
            lost = Parameter(0.0, 0.1, "1", low=0.0, high=0.99)
            says = "acted = commanded, up to (1 - lost) of the largest commanded"
            out.append(
                RobotEffect(f"command:{name}.saturation", says, {"lost": lost}, command=_limited(name, most))
            )
    return out
