"""Boundary posteriors in continuous time: where between two samples a contact changed.

The alignment says in which sample interval a boundary lies. Within it the contact itself is a
crossing: fingertips touch where the gap closes, a block lifts where the pads' shear force
reaches its weight, meets its support where the shear force begins to fall below it, and is let
go where a pad's compression reaches zero. The crossing quantity g is interpolated from both
ends (cubic Hermite with measured velocities; forces give compressions far more finely than
positions do), and its crossing time has the density of Rice's formula,

    p(t) ~ N(0; g(t), s(t)^2) E[max(dg/dt, 0)],

s being the propagated sensor noise and the interpolation's own uncertainty (Rice 1944;
docs/model.md). Touches stop the motion; they have a likelihood of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import norm

POINTS = 41  # nodes per sample interval
BEND = 0.025  # bend that the cubic misses, as a share of interval x change of velocity
UNSEEN = 0.25  # the same, as a share of the way that the velocities at both ends do not account for
APPROACH = 0.125  # s within which the approach to an impact may double or lose its speed
ONSET = 0.0015  # s; a pad's force leads its compression by its viscosity, a few ms in foam
LAUNCH = 0.1  # spread of the distance covered after a launch, over gain of speed x time
STOP, STOPS = (0.02, 1.0), 10  # time constants of the stop after an impact, over the interval
UNIFORM = 0.02  # weight of a crossing anywhere in the interval, against what g leaves out


@dataclass(frozen=True)
class Crossing:
    """A quantity [m] at both ends of a sample interval that crosses zero upwards inside it.

    `left`, `right`: its values; `v_left`, `v_right`: its rates [m/s]; `sd_*`: their noise.
    `kind`: "smooth" motion through the crossing; "impact": the crossing stops it (a touch, a
    touchdown); "launch": it sets in with the crossing (a block that was held down lifts off).
    """

    left: float
    right: float
    v_left: float
    v_right: float
    sd_left: float
    sd_right: float
    sd_v: float
    kind: Literal["smooth", "impact", "launch"] = "smooth"

    @property
    def known(self) -> bool:
        """Whether no sample that it needs is missing."""
        numbers = (self.left, self.right, self.v_left, self.v_right, self.sd_left, self.sd_right, self.sd_v)
        return bool(np.isfinite(numbers).all())


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


def crossing_density(crossings: list[Crossing], width: float) -> np.ndarray:
    """Density (POINTS,) over an interval of `width` s of the time at which all have crossed.

    With several crossings (two fingers that touch) the boundary is the last of them. None at
    all gives the uniform density. Sums to 1 over the nodes.
    """
    flat = np.full(POINTS, 1.0 / POINTS)
    if not crossings:
        return flat
    parts = [_single_density(c, width) for c in crossings]
    cumulative = np.prod([np.cumsum(p) for p in parts], axis=0)
    last = np.diff(cumulative, prepend=0.0)
    return (1 - UNIFORM) * last / last.sum() + UNIFORM * flat


def _single_density(c: Crossing, h: float) -> np.ndarray:
    u = (np.arange(POINTS) + 0.5) / POINTS
    log_density = {"smooth": _log_smooth, "impact": _log_impact, "launch": _log_launch}[c.kind](c, h, u)
    density = np.exp(log_density - log_density.max())
    return density / density.sum()


def _log_smooth(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Rice's formula on the cubic that joins both ends."""
    h00, h10, h01, h11 = _hermite(u)
    d00, d10, d01, d11 = _hermite_slopes(u)
    value = h00 * c.left + h10 * h * c.v_left + h01 * c.right + h11 * h * c.v_right
    slope = (d00 * c.left + d01 * c.right) / h + d10 * c.v_left + d11 * c.v_right
    unseen = c.right - c.left - h * (c.v_left + c.v_right) / 2
    bend = np.hypot(BEND * h * np.hypot(c.v_right - c.v_left, c.sd_v), UNSEEN * unseen)
    variance = (h00 * c.sd_left) ** 2 + (h01 * c.sd_right) ** 2
    variance += (h * c.sd_v) ** 2 * (h10**2 + h11**2) + (4 * u * (1 - u) * bend) ** 2
    rise = np.hypot(slope, c.sd_v + bend / h)
    return norm.logpdf(value, 0.0, np.sqrt(variance)) + np.log(rise * norm.cdf(slope / rise * 2))


def _log_impact(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Log likelihood of an impact at u: nearly uniform motion up to it, a quick stop after it.

    Up to the impact the finger covers -left at v_left, give or take an acceleration of its speed
    over APPROACH; after it the velocity decays to v_right with a time constant that is
    unknown (log-uniform over STOP, in units of h), which makes the compression `right`.
    """
    before, after = u * h, (1 - u) * h
    speed = max(c.v_left, -c.left / h, c.sd_v)
    # A motion that starts within the interval must speed up to get there, and get there before its end.
    needed = 2 * max(-c.left - max(c.v_left, 0.0) * h, 0.0) / h**2
    acceleration = np.hypot(speed / APPROACH, needed)
    covered = c.v_left * before + needed * before**2
    sd_before = np.sqrt(c.sd_left**2 + (c.sd_v * before) ** 2 + (acceleration * before**2 / 2) ** 2)
    log_before = norm.logpdf(-c.left, covered, sd_before)
    stop = h * np.geomspace(*STOP, STOPS)[:, None]
    reach = stop * -np.expm1(-after / stop)
    mean = c.v_right * (after - reach) + speed * reach
    sd_after = np.sqrt(c.sd_right**2 + (c.sd_v * after) ** 2 + (acceleration * before * reach) ** 2)
    log_after = norm.logpdf(c.right, mean, sd_after)
    return log_before + np.logaddexp.reduce(log_after, axis=0) + np.log(speed)


def _log_launch(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Log likelihood of a launch at u: a creep under load up to it, speed gained after it.

    Under load the fingers creep by -left at the load's own pace, of which v_left is a noisy early
    reading; from there to v_right they gain speed with constant jerk, as minimum-jerk motions
    set in, so that the gain covers a third of what full speed would, give or take LAUNCH.
    """
    before, after = u * h, (1 - u) * h
    creep = np.clip(-c.left / before, 0.0, max(c.v_right, c.sd_v))
    gain = np.hypot(c.v_right - creep, c.sd_v)
    sd = np.sqrt(c.sd_right**2 + (c.sd_v * after / 3) ** 2 + (LAUNCH * gain * after) ** 2)
    log_after = norm.logpdf(c.right, (creep + (c.v_right - creep) / 3) * after, sd) + np.log(gain)
    return log_after + norm.logpdf(c.v_left, 0.75 * creep, np.hypot(c.sd_v, 0.25 * creep))


def _hermite(u: np.ndarray) -> tuple[np.ndarray, ...]:
    return 2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, -2 * u**3 + 3 * u**2, u**3 - u**2


def _hermite_slopes(u: np.ndarray) -> tuple[np.ndarray, ...]:
    return 6 * u**2 - 6 * u, 3 * u**2 - 4 * u + 1, -6 * u**2 + 6 * u, 3 * u**2 - 2 * u


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
    return _blurred(np.concatenate(times), np.concatenate(probabilities), t[0], t[-1])


def _blurred(times: np.ndarray, probabilities: np.ndarray, first: float, last: float) -> BoundaryPosterior:
    """The posterior widened by ONSET, by Gauss-Hermite nodes of a normal distribution."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    spread = np.clip(times[:, None] + ONSET * nodes, first, last).ravel()
    mass = (probabilities[:, None] * weights).ravel()
    order = np.argsort(spread, kind="stable")
    return BoundaryPosterior(spread[order], mass[order] / mass.sum())
