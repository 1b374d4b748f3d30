"""Velocities that a drive makes of its own positions, and so come late.

A drive without a tachometer gives v[k] = (x[k] - x[k-m]) / (t[k] - t[k-m]): the velocity of m / 2 samples
ago, with the positions' own noise. At 20 Hz that is 25 ms, more than a contact change may be wrong by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.hand.signals import Signals, central_differences
from hmmseg.io.plausibility import position_pairs
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial

SPAN = 0.01  # chosen: s; fingers change their speed over some hundredths of a second
LONGEST = 4  # chosen: samples that such a difference spans at most
# numerics: what rounding leaves, against what a velocity of its own differs by from any difference
ALIKE = 0.1


def timely(signals: Signals, trial: Trial, rig: Rig) -> Signals:
    """The signals with central differences for velocities that are late differences of positions, or none."""
    dead = any(not np.isfinite(trial.channels[rate]).any() for _, rate in position_pairs(trial))
    return differenced(signals) if dead or come_late(trial, rig) else signals


def come_late(trial: Trial, rig: Rig) -> bool:
    """Whether a trial's velocities are late differences of its positions."""
    names = ("q11", "q12", "q21", "q22") if rig.jointed else ("x1", "y1", "x2", "y2")
    rates = [f"d{n}" if rig.jointed else f"v{n}" for n in names]
    pairs = [(trial.channels[n], trial.channels[r]) for n, r in zip(names, rates, strict=True)
             if r in trial.channels]  # fmt: skip
    return bool(pairs) and all(late_differences(trial.t, *pair) for pair in pairs)


def differenced(signals: Signals) -> Signals:
    """The signals with central differences of positions for velocities."""
    made = {}
    for axis in "xy":
        for i in (1, 2):
            made[f"v{axis}{i}"], window = central_differences(signals.t, getattr(signals, f"{axis}{i}"))
        made[f"sd_v{axis}"] = np.sqrt(2.0) * getattr(signals, f"sd_{axis}") / window
    return replace(signals, derived=True, **made)


def late_differences(t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> bool:
    """Whether velocity (num_timesteps,) repeats the backward differences of position over some samples."""
    central = _residual(velocity[1:-1], (position[2:] - position[:-2]) / (t[2:] - t[:-2]))
    backward = [
        _residual(velocity[m:], (position[m:] - position[:-m]) / (t[m:] - t[:-m]))
        for m in range(1, min(LONGEST + 1, t.size - 1))
    ]
    return bool(backward) and bool(min(backward) < ALIKE * central)


def one_sided(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Rates (2, num_timesteps) of change just before and just after each sample, from that side alone.

    A difference across a touch is of neither side. Each is the slope at the end of a parabola through
    three readings SPAN apart, or a sample's interval. Also their noise over that of a reading [1/s].
    """
    there = np.isfinite(values)
    h = max(SPAN, float(np.median(np.diff(t))))
    noise = float(np.sqrt(1.5**2 + 2**2 + 0.5**2) / h)
    if there.sum() < 2:
        return np.full((2, t.size), np.nan), noise

    def read(at: np.ndarray) -> np.ndarray:
        return np.interp(at, t[there], values[there])

    before = (1.5 * values - 2 * read(t - h) + 0.5 * read(t - 2 * h)) / h
    after = (-1.5 * values + 2 * read(t + h) - 0.5 * read(t + 2 * h)) / h
    return np.stack([before, after]), noise


def _residual(velocity: np.ndarray, difference: np.ndarray) -> float:
    """Mean absolute residual [m/s or rad/s], infinite of none."""
    apart = np.abs(velocity - difference)
    apart = apart[np.isfinite(apart)]
    return float(apart.mean()) if apart.size else np.inf
