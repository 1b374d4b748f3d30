"""A drive whose command is off by a constant: a joint's zero as the drive has it."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting, drives, places
from simgap.simulators.protocol import Parameter


def _shifted(name: str):
    return lambda recording, theta: recording.with_columns({name: recording[name] + theta["offset"]})


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command; its usual size is 3 % of the command's spread."""
    out = []
    for name in (*drives(setting), *places(setting)):
        channel = setting.simulator.channels[name]
        if channel.unit != "1":
            offset = Parameter(0.0, 0.03 * setting.spread(name), channel.unit)
            out.append(
                RobotEffect(
                    f"command:{name}.offset",
                    "acted = commanded + offset",
                    {"offset": offset},
                    command=_shifted(name),
                )
            )
    return out
