"""A drive that takes its command times a wrong factor."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting, drives, places
from simgap.simulators.protocol import Parameter

WORDS = {
    "command.gain": (
        "commands that are carried out too weakly or strongly",
        "Command a known step and measure the motion.",
    ),
}


def _scaled(name: str):
    return lambda recording, theta: recording.with_columns({name: (1 + theta["gain"]) * recording[name]})


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command."""
    gain = Parameter(0.0, 0.03, "1", low=-0.9)
    return [
        RobotEffect(
            f"command:{name}.gain", "acted = (1 + gain) commanded", {"gain": gain}, command=_scaled(name)
        )
        for name in (*drives(setting), *places(setting))
    ]
