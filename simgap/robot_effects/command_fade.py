"""A drive whose torque falls behind its command as that grows, with duty or current."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, drives
from simgap.simulators.protocol import Parameter

WORDS = {
    "command.fade": (
        "a drive that falls behind large commands",
        "Command a large constant torque and measure it.",
    ),
}


def _faded(name: str, most: float):
    def act(recording, theta):
        values = recording[name]
        return recording.with_columns({name: values * (1 - theta["fade"] * np.abs(values) / most)})

    return act


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command that drives torque or duty; `fade` is what is lost at the largest command."""
    out = []
    for name in drives(setting):
        most = setting.largest(name)
        if most > 0:
            fade = Parameter(0.0, 0.1, "1", low=-0.9, high=0.9)
            says = "acted = commanded (1 - fade |commanded| / largest)"
            out.append(RobotEffect(f"command:{name}.fade", says, {"fade": fade}, command=_faded(name, most)))
    return out
