"""A read-out that is off by a constant: a sensor's bias, an encoder's zero."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Parameter


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel; its usual size is 3 % of the channel's spread."""
    out = []
    for name in setting.alone():
        bias = Parameter(0.0, 0.03 * setting.spread(name), setting.simulator.channels[name].unit)
        out.append(
            RobotEffect(
                f"readout:{name}.bias", "recorded = true + bias", {"bias": bias}, name,
                read=lambda since, values, theta: values + theta["bias"],
                undo=lambda since, values, theta: values - theta["bias"],
            )
        )  # fmt: skip
    return out
