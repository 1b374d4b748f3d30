"""Measured positions on a wrong scale, all of them alike: a camera's calibration, a marker's true size."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Channels, Parameter
from simgap.simulators.recording import Recording

WORDS = {
    "readout.scale": (
        "lengths that are all read too long or too short",
        "Measure a known distance with the tracking system.",
    ),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for all lengths that are read, where there are several."""
    known = setting.simulator.channels
    names = [n for n in setting.compared("position") if known[n].unit == "m"]
    if len(names) < 2:
        return []

    def scaled(window: Recording, channels: Channels, theta) -> Channels:
        return {n: (1 + theta["scale"]) * channels[n] for n in names}

    def unscaled(log: Recording, theta) -> Recording:
        return log.with_columns({n: log[n] / (1 + theta["scale"]) for n in names})

    scale = Parameter(0.0, 0.02, "1", low=-0.9)
    says = "recorded positions = (1 + scale) true ones"
    return [RobotEffect("readout.scale", says, {"scale": scale}, alter=scaled, restore=unscaled)]
