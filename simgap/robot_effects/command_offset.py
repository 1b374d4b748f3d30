"""A drive whose command is off by a constant: a joint's zero as the drive has it."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting, drives, places

WORDS = {
    "command.offset": (
        "commands that are carried out with an offset",
        "Command the home position and measure where the robot is.",
    ),
}


def _shifted(name: str):
    return lambda recording, theta: recording.with_columns({name: recording[name] + theta["offset"]})


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command that has a unit; its usual size is 3 % of the command's spread."""
    return [
        RobotEffect(
            f"command:{name}.offset",
            "acted = commanded + offset",
            {"offset": setting.usual(name, 0.03)},
            command=_shifted(name),
        )
        for name in (*drives(setting), *places(setting))
        if setting.simulator.channels[name].unit != "1"
    ]
