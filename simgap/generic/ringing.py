"""Damped oscillations after an event: frequency and damping from the recorded samples themselves.

y(t) = parabola + exp(-damping w t) (A sin w t + B cos w t) from the largest swing on, w = 2 pi f; A, B and
the parabola of every trial its own, f and damping common. For given f and damping that is linear least
squares (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973); the two are searched on a
grid and refined. Intervals from the scatter between trials (jackknife), which needs no noise model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import stdtrit

DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.2)  # numerics: where searches start
HEAVIEST = 0.25  # chosen: damping beyond which a course is no ring
FREQUENCIES = 80  # numerics: where searches start
SWING = 1 / 3  # chosen: of a window within which the largest swing is looked for
LEAST = 12  # numerics: samples
PERIODS = 1.5  # chosen: of the slowest oscillation looked for that a window holds
HIGHEST = 0.4  # chosen: of the sampling rate


@dataclass(frozen=True)
class Ring:
    """`frequency` [Hz], `damping` (ratio to critical) with standard errors and 90 % intervals;
    `amplitude` (n,) of each trial at the start; `share` of the square about the parabola explained;
    `resolved`: whether the best frequency lies inside the range looked at and the damping is light."""

    frequency: float
    damping: float
    frequency_sd: float
    damping_sd: float
    frequency_90: tuple[float, float]
    damping_90: tuple[float, float]
    amplitude: np.ndarray
    share: float
    resolved: bool = True


def from_swing(windows: Sequence[np.ndarray]) -> np.ndarray:
    """Windows (trials, n) from the largest departure from each one's median on, cut to equal length.

    The largest swing is looked for in the first third.
    """
    cut = []
    for values in windows:
        early = values[: max(int(values.size * SWING), 1)]
        cut.append(values[int(np.abs(early - np.median(values)).argmax()) :])
    n = min(v.size for v in cut)
    return np.array([v[:n] for v in cut])


def limits(length: int, rate: float) -> tuple[float, float] | None:
    """Lowest and highest frequency [Hz] that windows of so many samples tell; None where none."""
    low, high = PERIODS * rate / max(length, 1), HIGHEST * rate
    return (low, high) if length >= LEAST and low < high else None


def screen(windows: np.ndarray, rate: float, at_least: float = 0.0) -> tuple[float, float, float, float]:
    """Best frequency [Hz] and damping on a grid, the share of the square about the parabola explained and
    its mean square; zeros where windows are too short."""
    edges = limits(windows.shape[1], rate)
    if edges is None or max(edges[0], at_least) >= edges[1]:
        return np.nan, np.nan, 0.0, 0.0
    grid = [(f, z) for f in np.geomspace(max(edges[0], at_least), edges[1], FREQUENCIES) for z in DAMPINGS]
    shares = [1 - _left(windows, rate, *g)[0] for g in grid]
    best = int(np.argmax(shares))
    t = np.linspace(-1, 1, windows.shape[1])
    plain = windows.T - _fitted(np.stack([np.ones_like(t), t, t**2], 1), windows.T)
    return *grid[best], float(shares[best]), float(shares[best] * (plain**2).mean())


def fit_ring(windows: np.ndarray, rate: float, at_least: float = 0.0) -> Ring | None:
    """A ring common to windows (trials, n) of samples at `rate` [Hz]; None where they are too short."""
    edges = limits(windows.shape[1], rate)
    start = screen(windows, rate, at_least)
    if edges is None or not np.isfinite(start[0]):
        return None
    edges = max(edges[0], at_least), edges[1]
    best = _refined(windows, rate, start[:2], edges)
    left, amplitude = _left(windows, rate, *best)
    inside = edges[0] * 1.01 < best[0] < edges[1] * 0.99 and best[1] < 0.99 * HEAVIEST
    n = len(windows)
    if n == 1:
        none = (np.nan, np.nan)
        return Ring(*best, np.nan, np.nan, none, none, amplitude, 1 - left, inside)
    each = np.array([_refined(np.delete(windows, i, 0), rate, best, edges) for i in range(n)])
    logs = np.log(each)  # both are positive
    sd = np.sqrt((n - 1) / n * ((logs - logs.mean(0)) ** 2).sum(0))
    reach = -float(stdtrit(n - 1, 0.05)) * sd
    low, high = best * np.exp(-reach), best * np.exp(reach)
    return Ring(
        *best,
        float(best[0] * sd[0]),
        float(best[1] * sd[1]),
        (float(low[0]), float(high[0])),
        (float(low[1]), float(high[1])),
        amplitude,
        1 - left,
        inside,
    )


def _refined(windows, rate, start, edges) -> tuple[float, float]:
    found = minimize(
        lambda u: np.log(_left(windows, rate, *np.exp(u))[0]), np.log(start), method="Nelder-Mead",
        bounds=[tuple(np.log(edges)), (np.log(1e-3), np.log(HEAVIEST))],
        options={"xatol": 1e-4, "fatol": 1e-7, "maxiter": 150},
    )  # fmt: skip
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def _left(windows: np.ndarray, rate: float, frequency: float, damping: float) -> tuple[float, np.ndarray]:
    """Share of the squares about each window's parabola that a ring leaves; amplitudes (trials,)."""
    t = np.arange(windows.shape[1]) / rate
    s = 2 * t / t[-1] - 1
    plain = windows.T - _fitted(np.stack([np.ones_like(s), s, s**2], 1), windows.T)
    omega = 2 * np.pi * frequency
    decay = np.exp(-damping * omega * t)
    basis = np.stack([np.ones_like(s), s, s**2, decay * np.sin(omega * t), decay * np.cos(omega * t)], 1)
    found = np.linalg.lstsq(basis, windows.T, rcond=None)[0]
    rest = windows.T - basis @ found
    size = np.maximum((plain**2).sum(0), 1e-300)  # each trial counts alike
    return float(((rest**2).sum(0) / size).mean()) + 1e-300, np.hypot(*found[3:])


def _fitted(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    return basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
