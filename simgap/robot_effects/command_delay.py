"""Commands that reach the drives late."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, Theta
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording

WORDS = {
    "command.delay": ("commands that are carried out late", "Log commands and motion with one clock."),
}


def _late(names: list[str]):
    def late(recording: Recording, theta: Theta) -> Recording:
        at = recording.t - theta["delay"]
        return recording.with_columns({n: np.interp(at, recording.t, recording[n]) for n in names})

    return late


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for all commands together; they hold their first value before the log's start."""
    names = setting.commands()
    if not names:
        return []
    delay = Parameter(0.0, 0.01, "s", low=0.0, high=0.5)
    return [
        RobotEffect(
            "command.delay", "acted(t) = commanded(t - delay)", {"delay": delay}, command=_late(names)
        )
    ]
