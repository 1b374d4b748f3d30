"""A supply whose voltage is recorded and drives torque: less voltage, less torque for the same duty."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, drives
from simgap.simulators.protocol import Parameter

WORDS = {
    "supply.sag": (
        "torque that falls with the supply's voltage",
        "Measure the voltage at the drive under load.",
    ),
}


def _sagging(names: list[str], supply: str, usual: float):
    def act(recording, theta):
        scale = 1 + theta["share"] * (recording[supply] / usual - 1)
        return recording.with_columns({n: scale * recording[n] for n in names})

    return act


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each command in V that varies, acting on all commands that drive."""
    names = drives(setting)
    out = []
    for supply in setting.commands():
        values = np.concatenate([r[supply] for r in setting.recordings])
        if setting.simulator.channels[supply].unit != "V" or not names or np.nanstd(values) == 0:
            continue
        usual = float(np.nanmedian(values))
        share = Parameter(0.0, 0.3, "1", low=-3.0, high=6.0)
        out.append(
            RobotEffect(
                f"supply:{supply}.sag",
                "torque follows the supply's voltage by this share",
                {"share": share},
                command=_sagging([n for n in names if n != supply], supply, usual),
            )
        )
    return out
