"""Robust statistics, insensitive to a few outliers."""

from __future__ import annotations

from math import comb

import numpy as np

NORMAL = 1.4826  # physics: ratio of a normal variable's standard deviation to its median absolute value


def robust_sd(residual: np.ndarray) -> float:
    """Standard deviation of normal residuals about zero, from their median absolute value."""
    return NORMAL * float(np.median(np.abs(residual)))


WITHIN = (np.arange(16) - 7.5) / 16  # numerics: places within a step of a channel


def white_sd(values: np.ndarray, order: int = 2, step: float = 0.0) -> float:
    """Standard deviation of white noise, from differences of this order along the first axis.

    A difference of order k has (2 k choose k) times the variance of the noise; the median absolute value
    ignores the few samples at which the signal itself bends. Of readings in steps that median would be a
    whole number of steps, so every difference counts as spread over its `step`.
    """
    differences = np.diff(values, order, axis=0)
    sd = robust_sd(np.add.outer(step * WITHIN, differences)) if step else robust_sd(differences)
    return float(np.sqrt(max(sd**2 - step**2 / 12, 0.0) / comb(2 * order, order)))


def coarse_step(values: np.ndarray) -> float:
    """Step between the readings of a channel if it is coarser than their noise, else 0.

    Noise of half a step repeats a reading as often as it moves it by one or two; faster motion tells nothing.
    """
    there = values[np.isfinite(values)]
    step = float(np.diff(np.unique(np.round(there, 9))).min(initial=np.inf)) if there.size > 1 else np.inf
    moved = np.abs(np.diff(there)) / step
    still, near = (moved < 0.5).sum(), (moved < 2.5).sum()
    return step if still > near / 2 + np.sqrt(near) else 0.0  # by two sds of a fair chance


def runs(found: np.ndarray) -> list[tuple[int, int]]:
    """Start and stop of each run of true samples."""
    edges = np.flatnonzero(np.diff(np.r_[False, found, False].astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """The finite value at which half of the total weight is reached."""
    keep = np.isfinite(values) & (weights > 0)
    return float(np.quantile(values[keep], 0.5, weights=weights[keep], method="inverted_cdf"))


def extent(values: np.ndarray) -> float:
    """Range of the finite values, 0 of none."""
    there = values[np.isfinite(values)]
    return float(np.ptp(there)) if there.size else 0.0


def median_of_known(values: np.ndarray, otherwise: float = np.nan) -> float:
    """Median of the finite values."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else otherwise


def bridged(values: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
    """Values (num_samples,) with missing ones interpolated over times `t`, or over samples.

    ValueError if all are missing.
    """
    there = np.isfinite(values)
    t = np.arange(values.size) if t is None else t
    return values if there.all() else np.interp(t, t[there], values[there])


def filled(values: np.ndarray) -> np.ndarray:
    """The same over samples, zeros if all are missing."""
    return bridged(values) if np.isfinite(values).any() else np.zeros(values.size)
