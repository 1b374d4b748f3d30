"""A read-out that is off by a constant: a sensor's bias, an encoder's zero."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting

WORDS = {
    "readout.bias": (
        "a zero error of a reading",
        "Record two seconds at rest and compare with the model's value.",
    ),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel; its usual size is 3 % of the channel's spread."""
    return [
        RobotEffect(
            f"readout:{name}.bias", "recorded = true + bias", {"bias": setting.usual(name, 0.03)}, name,
            read=lambda since, values, theta: values + theta["bias"],
            undo=lambda since, values, theta: values - theta["bias"],
        )
        for name in setting.alone()
    ]  # fmt: skip
