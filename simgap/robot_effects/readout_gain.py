"""A read-out with a wrong scale: a sensor's gain, a gear ratio, the scale of measured positions."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Parameter

WORDS = {
    "readout.gain": (
        "a reading that is off by a factor",
        "Compare the sensor with a known load or distance; check its unit and scale.",
    ),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel."""
    return [
        RobotEffect(
            f"readout:{name}.gain", "recorded = (1 + gain) true",
            {"gain": Parameter(0.0, 0.03, "1", low=-0.9)}, name,
            read=lambda since, values, theta: (1 + theta["gain"]) * values,
            undo=lambda since, values, theta: values / (1 + theta["gain"]),
        )
        for name in setting.alone()
    ]  # fmt: skip
