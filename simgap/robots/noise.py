"""The noise of each channel: as stated or learned from differences, at least its resolution's."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from hmmseg.robust import robust_sd
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

ORDERS = (2, 4)  # numerics: of differences: the second is less noisy, the fourth blinder to motion


def resolution(values: np.ndarray) -> float:
    """The step that all values are whole multiples of apart, 0 where there is none."""
    distinct = np.unique(np.round(values[np.isfinite(values)], 9))
    if distinct.size < 3:
        return 0.0
    gaps = np.diff(distinct)
    step = float(gaps.min())
    multiples = gaps / step
    off = np.abs(multiples - np.round(multiples))
    return step if np.quantile(off, 0.95) < 0.05 else 0.0


def learned(recordings: Sequence[Recording], name: str) -> float:
    """Standard deviation of white noise from differences, robustly, the least of those of ORDERS.

    Of order n they have variance C(2n, n) sigma^2, the sum of squared binomials, and motion only adds to it:
    a second difference holds gravity, a fourth no parabola.
    """
    return min(_by_difference(recordings, name, order) for order in ORDERS)


def _by_difference(recordings: Sequence[Recording], name: str, order: int) -> float:
    found = np.concatenate([np.diff(r[name], order) for r in recordings])
    found = found[np.isfinite(found)]
    if not found.size:
        return 1.0
    return float(robust_sd(found) / np.sqrt(comb(2 * order, order)))


def noises(simulator: Simulator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Standard deviation of one sample of every compared channel [its unit], at least step / sqrt(12)."""
    out = {}
    for name, channel in simulator.channels.items():
        if channel.kind == "command":
            continue
        step = max(resolution(r[name]) for r in recordings)
        stated = channel.noise if np.isfinite(channel.noise) else learned(recordings, name)
        found = max(stated, step / np.sqrt(12.0))
        out[name] = found if found > 0 else 1e-6 * max(1.0, float(np.nanstd(recordings[0][name])))
    return out
