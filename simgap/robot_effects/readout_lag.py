"""A read-out that comes late by a constant time."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, delayed
from simgap.simulators.protocol import Parameter

WORDS = {
    "readout.lag": ("a reading that comes late", "Compare time stamps of two channels at a sharp event."),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel. A stamp that is late makes the delay negative."""
    return [
        RobotEffect(
            f"readout:{name}.lag", "recorded(t) = true(t - delay)",
            {"delay": Parameter(0.0, 0.01, "s", low=-0.2, high=0.5)}, name,
            read=lambda since, values, theta: delayed(since, values, theta["delay"]),
            undo=lambda since, values, theta: np.interp(since + theta["delay"], since, values),
        )
        for name in setting.late_alone()
    ]  # fmt: skip
