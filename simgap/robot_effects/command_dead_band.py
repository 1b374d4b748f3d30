"""A drive that does nothing for small commands."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, drives

WORDS = {
    "command.dead_band": (
        "commands too small to do anything",
        "Raise the command slowly from nothing and note where motion begins.",
    ),
}


def _dead(name: str):
    def act(recording, theta):
        values = recording[name]
        return recording.with_columns(
            {name: np.sign(values) * np.maximum(np.abs(values) - theta["band"], 0.0)}
        )

    return act


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command that drives torque or duty, which is 0 where nothing is to be done."""
    return [
        RobotEffect(
            f"command:{name}.dead_band",
            "acted = commanded less a band about 0",
            {"band": setting.usual(name, 0.03, low=0.0)},
            command=_dead(name),
        )
        for name in drives(setting)
    ]
