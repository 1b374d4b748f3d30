"""A read-out that drifts at a constant rate from the log's start on."""

from __future__ import annotations

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Parameter

WORDS = {
    "readout.drift": ("a reading whose zero drifts", "Record a minute at rest after switching on."),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel; over the longest log it usually drifts by 3 % of the channel's spread."""
    longest = max(float(r.t[-1] - r.t[0]) for r in setting.recordings)
    out = []
    for name in setting.alone():
        unit = setting.simulator.channels[name].unit
        rate = Parameter(0.0, 0.03 * setting.sd(name) / longest, f"{unit}/s")
        out.append(
            RobotEffect(
                f"readout:{name}.drift", "recorded = true + rate (t - t0)", {"rate": rate}, name,
                read=lambda since, values, theta: values + theta["rate"] * since,
                undo=lambda since, values, theta: values - theta["rate"] * since,
            )
        )  # fmt: skip
    return out
