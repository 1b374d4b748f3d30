"""A read-out through a first-order low-pass."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, onset
from simgap.simulators.protocol import Parameter

SHORTEST = 1e-9  # numerics: s: below this nothing is smoothed

WORDS = {
    "readout.lowpass": ("a slow filter in a reading", "Look up the filter setting of this channel."),
}


def lowpass(since: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """tau y' + y = u for values u (num_timesteps,) linear between samples, exactly.

    Before the start u was a parabola, which y had settled to follow: y = u - tau u' + tau^2 u''.
    """
    if time_constant < SHORTEST or len(values) < 3:
        return values
    steps = np.diff(since)
    slopes = np.diff(values) / steps
    kept = np.exp(-steps / time_constant)
    out = np.empty_like(values)
    slope, bend = onset(since, values)
    out[0] = values[0] - time_constant * slope + time_constant**2 * bend
    for i, (keep, slope) in enumerate(zip(kept, slopes, strict=True)):
        # On each piece y = u - tau slope + decaying rest.
        rest = out[i] - (values[i] - time_constant * slope)
        out[i + 1] = values[i + 1] - time_constant * slope + keep * rest
    return out


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for each channel."""
    return [
        RobotEffect(
            f"readout:{name}.lowpass", "time_constant recorded' + recorded = true",
            {"time_constant": Parameter(0.0, 0.01, "s", low=0.0, high=0.5)}, name,
            read=lambda since, values, theta: lowpass(since, values, theta["time_constant"]),
            undo=lambda since, values, theta: values + theta["time_constant"] * np.gradient(values, since),
        )
        for name in setting.late_alone()
    ]  # fmt: skip
