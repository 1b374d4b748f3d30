"""Boundary posteriors in continuous time: where between two samples a contact changed.

The alignment says in which sample interval a boundary lies. Within it the contact itself is a
crossing: fingertips touch where the gap closes, a block lifts where the pads' shear force
reaches its weight, meets its support where the shear force begins to fall below it, and is let
go where a pad's compression reaches zero (`hmmseg.segmentation.motions`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from hmmseg.segmentation.motions import POINTS, Crossing, last_impact, log_launch, log_smooth

ONSET = 0.001  # prior: s; a pad's force leads its compression by its viscosity, a few ms in foam
UNIFORM = 0.02  # prior: weight of a crossing anywhere in the interval, against what g leaves out


@dataclass(frozen=True)
class BoundaryPosterior:
    """Posterior of one boundary: probabilities (M,) at times (M,) [s], increasing."""

    times: np.ndarray
    probabilities: np.ndarray

    def quantile(self, q: float) -> float:
        """Time [s] below which the boundary lies with probability q."""
        cumulative = np.cumsum(self.probabilities)
        middle = cumulative - self.probabilities / 2
        return float(np.interp(q, middle, self.times))

    @property
    def mean(self) -> float:
        """Posterior mean [s]."""
        return float(self.times @ self.probabilities)

    @property
    def sd(self) -> float:
        """Posterior standard deviation [s]."""
        return float(np.sqrt(self.probabilities @ (self.times - self.mean) ** 2))


def normal(mean: float, sd: float) -> BoundaryPosterior:
    """A boundary at a normally distributed time [s]."""
    shares = (np.arange(POINTS) + 0.5) / POINTS
    return BoundaryPosterior(mean + sd * ndtri(shares), np.full(POINTS, 1 / POINTS))


def crossing_density(crossings: list[Crossing], width: float) -> np.ndarray:
    """Density (POINTS,) over an interval of `width` s of the time at which all have crossed.

    With several crossings (two fingers that touch) the boundary is the last of them. None at
    all gives the uniform density. Sums to 1 over the nodes.
    """
    flat = np.full(POINTS, 1.0 / POINTS)
    if not crossings:
        return flat
    if all(c.kind == "impact" for c in crossings):
        last = np.diff(last_impact(crossings, width), prepend=0.0)
    else:
        parts = [_single_density(c, width) for c in crossings]
        last = np.diff(np.prod([np.cumsum(p) for p in parts], axis=0), prepend=0.0)
    return (1 - UNIFORM) * last / last.sum() + UNIFORM * flat


def _single_density(c: Crossing, h: float) -> np.ndarray:
    if c.kind == "impact":
        return np.diff(last_impact([c], h), prepend=0.0)
    u = (np.arange(POINTS) + 0.5) / POINTS
    log_density = (log_smooth if c.kind == "smooth" else log_launch)(c, h, u)
    density = np.exp(log_density - log_density.max())
    return (1 - c.anywhere) * density / density.sum() + c.anywhere / POINTS


def first_of(crossings: list[Crossing], width: float) -> np.ndarray:
    """Density (POINTS,) of the time at which the first of the crossings happens."""
    if not crossings:
        return crossing_density([], width)
    survival = np.prod([1 - np.cumsum(_single_density(c, width)) for c in crossings], axis=0)
    first = -np.diff(survival, prepend=1.0)
    return (1 - UNIFORM) * first / first.sum() + UNIFORM / POINTS


def combine(
    t: np.ndarray, interval_probability: np.ndarray, densities: dict[int, np.ndarray]
) -> BoundaryPosterior:
    """Boundary posterior from the probability (T-1,) of each interval and densities within.

    Intervals without a density of their own are uniform; those of probability below 1e-6 are
    left out.
    """
    u = (np.arange(POINTS) + 0.5) / POINTS
    times, probabilities = [], []
    for n in np.flatnonzero(interval_probability > 1e-6):
        density = densities.get(int(n), np.full(POINTS, 1.0 / POINTS))
        times.append(t[n] + u * (t[n + 1] - t[n]))
        probabilities.append(interval_probability[n] * density)
    return blurred(np.concatenate(times), np.concatenate(probabilities), t[0], t[-1])


def blurred(
    times: np.ndarray, probabilities: np.ndarray, first: float, last: float, sd: float = ONSET
) -> BoundaryPosterior:
    """The posterior widened by `sd` [s], by Gauss-Hermite nodes of a normal distribution."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    spread = np.clip(times[:, None] + sd * nodes, first, last).ravel()
    mass = (probabilities[:, None] * weights).ravel()
    order = np.argsort(spread, kind="stable")
    return BoundaryPosterior(spread[order], mass[order] / mass.sum())
