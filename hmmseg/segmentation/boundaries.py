"""Continuous-time contact changes between two samples, and posteriors of boundaries.

The alignment gives the sample interval of a boundary. Within it the contact itself is a crossing: fingertips
touch when the gap closes; a block lifts when the pads' shear force reaches its weight, meets its support when
the shear force starts to fall below it, and is released when a pad's compression vanishes.

A crossing quantity g (a gap, or a height above where the pads' shear carries the block) is known at both ends
of a sample interval; forces give compressions far more precisely than positions do. Smooth motion follows the
cubic that joins both ends with the measured velocities; the density of its crossing time is Rice's formula,

    p(t) ~ N(0; g(t), s(t)^2) E[max(dg/dt, 0)],

where s combines the propagated sensor noise with the uncertainty of the interpolation (Rice 1944;
docs/segmentation.md). Touches stop the motion: they occur during a minimum-jerk motion (Flash and Hogan 1985)
whose start and duration are common to both fingers. So do landings, but of a motion that is corrected on its
way down: their speed wanders until they stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from hmmseg.tables import Brief

POINTS = 41  # numerics: nodes per sample interval
NODES = (np.arange(POINTS) + 0.5) / POINTS  # numerics: the nodes, as shares of the interval
LAUNCH = 0.1  # prior: spread of the distance covered after a launch, over gain of speed x time
MOTION, MOTIONS = (0.05, 1.0), 16  # prior: s; duration of the motion that an impact ends: log-uniform
STARTS = 48  # numerics: nodes over the time at which that motion started
SHAPE = 0.05  # prior: relative deviation of its speed from the minimum-jerk profile
# prior: s; time constant with which an impact stops the motion: sqrt(m / k) of 0.1 to 0.3 kg on 1 to 3 N/mm
STOP = 0.01
REBOUND = 0.7  # prior: relative deviation of the way that this takes, as a hand that hits fast rebounds
SPEEDS = np.linspace(-3.0, 3.0, 13)  # numerics: nodes of a normal distribution of speeds, in its sd

Kind = Literal["smooth", "impact", "landing", "launch"]


@dataclass(frozen=True)
class Crossing:
    """A quantity [m] known at both ends of a sample interval that crosses zero upwards inside it.

    `left`, `right`: its values; `v_left`, `v_right`: its rates [m/s]; `sd_*`: their noise. `kind`: "smooth"
    motion through the crossing; "impact": one motion is stopped by it (a touch); "landing": one that is
    corrected on its way is (a touchdown); "launch": motion starts with it (a block that was held down lifts
    off). `earlier`: an earlier sample, as (time before the left end [s], value, rate). `restless` [m^2/s^3]:
    variance a second by which the rate wanders before a landing.
    """

    left: float
    right: float
    v_left: float
    v_right: float
    sd_left: float
    sd_right: float
    sd_v: float
    kind: Kind = "smooth"
    earlier: tuple[float, float, float] | None = None
    restless: float = 0.0

    @property
    def known(self) -> bool:
        """Whether all required samples are present."""
        numbers = (self.left, self.right, self.v_left, self.v_right, self.sd_left, self.sd_right, self.sd_v,
                   self.restless)  # fmt: skip
        return bool(np.isfinite(numbers).all())


def log_smooth(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Log likelihood of a smooth crossing at u: Rice's formula on the cubic, give or take a bend [m].

    The rate is a Brownian motion between both ends. Its variance is read off the change of velocity and the
    way that both velocities do not explain: a hand that starts to move within the interval shows in both.
    """
    h00, h10, h01, h11 = 2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, -2 * u**3 + 3 * u**2, u**3 - u**2
    d00, d10, d01, d11 = 6 * u**2 - 6 * u, 3 * u**2 - 4 * u + 1, -6 * u**2 + 6 * u, 3 * u**2 - 2 * u
    value = h00 * c.left + h10 * h * c.v_left + h01 * c.right + h11 * h * c.v_right
    slope = (d00 * c.left + d01 * c.right) / h + d10 * c.v_left + d11 * c.v_right
    unseen = c.right - c.left - h * (c.v_left + c.v_right) / 2
    wandered = (h**2 * ((c.v_right - c.v_left) ** 2 + c.sd_v**2) + 12 * unseen**2) / 2
    variance = (h00 * c.sd_left) ** 2 + (h01 * c.sd_right) ** 2
    variance += (h * c.sd_v) ** 2 * (h10**2 + h11**2) + wandered * (u * (1 - u)) ** 3 / 3
    rise = np.hypot(slope, c.sd_v + np.sqrt(wandered / 192) / h)
    return _log_normal(value, 0.0, np.sqrt(variance)) + np.log(rise * ndtr(slope / rise * 2))


def last_impact(impacts: list[Crossing], h: float) -> np.ndarray:
    """Probability (POINTS,) that all fingers have hit by each node of an interval of h s.

    The fingers move as one, so duration and start of the motion are marginalised jointly. Distance, noise and
    stopping are each finger's own.
    """
    duration = np.geomspace(*MOTION, MOTIONS)[:, None, None]
    starts = (np.arange(STARTS) + 0.5) / STARTS
    age = starts[:, None] * (duration + h) - h  # since its start, at the first sample; uniform
    log_prior = np.log(duration + h)[..., 0] + np.zeros(STARTS)
    log_prior = log_prior - np.logaddexp.reduce(log_prior, axis=None)
    together, every = log_prior, np.ones(1)
    for c in impacts:
        log_density = _log_impact(c, h, NODES, duration, age / duration)
        peak = log_density.max(axis=-1, keepdims=True)
        density = np.exp(log_density - peak)
        total = density.sum(axis=-1)
        together = together + peak[..., 0] + np.log(total)
        every = every * (np.cumsum(density, axis=-1) / total[..., None])
    weight = np.exp(together - together.max())
    return (weight[..., None] * every).sum(axis=(0, 1)) / weight.sum()


def _log_impact(c: Crossing, h: float, u: np.ndarray, duration: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Log likelihood of an impact at u, ending a minimum-jerk motion.

    The motion of this `duration` [s] is at this `phase` (0 to 1) at the first sample. Its distance is unknown
    (log-uniform) and determined by gap and velocity of the first sample. The face that it hits is equally
    likely anywhere along the way.
    """
    at_hit = phase + u * h / duration
    way = np.maximum(_minimum_jerk(at_hit) - _minimum_jerk(phase), 1e-9)
    rate, rate_at_hit = _minimum_jerk_slope(phase) / duration, _minimum_jerk_slope(at_hit) / duration
    gap, sd_v = -c.left, np.hypot(c.sd_v, SHAPE * max(c.v_left, -c.left / h))
    # Each reading ~ N(distance x share, sd), distance integrated out: gap and speed, then earlier ones.
    readings = [(way, gap, c.sd_left), (rate, c.v_left, sd_v)]
    if c.earlier is not None:
        ago, value, speed = c.earlier
        then, covered = phase - ago / duration, value - c.left
        readings += [
            (_minimum_jerk(then) - _minimum_jerk(phase), covered,
             np.hypot(np.sqrt(2.0) * c.sd_left, SHAPE * covered)),
            (_minimum_jerk_slope(then) / duration, speed,
             np.hypot(c.sd_v, SHAPE * max(speed, -covered / ago))),
        ]  # fmt: skip
    precision = sum((share / sd) ** 2 for share, _, sd in readings)
    weighed = sum(share * x / sd**2 for share, x, sd in readings)
    distance = np.maximum(weighed / precision, c.sd_left)
    left_over = sum((x / sd) ** 2 for _, x, sd in readings) - weighed**2 / precision
    log_before = -0.5 * left_over - 0.5 * np.log(precision) - np.log(distance)
    speed = np.maximum(distance * rate_at_hit, c.sd_v)
    log_hit = np.log(np.maximum(rate_at_hit, 1e-300)) + np.log(speed)
    return log_before + log_hit + _log_stopped(c, speed, (1 - u) * h)


def log_landing(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Log likelihood of a landing at u, ending a motion that is corrected on its way.

    One motion may end and another begin between two samples, so until the hit the rate wanders as it did
    before (`restless`): integrated Brownian motion, of which way and speed at the hit are jointly normal.
    """
    before = (u * h)[:, None]
    way = c.sd_left**2 + (before * c.sd_v) ** 2 + c.restless * before**3 / 3
    both = before * c.sd_v**2 + c.restless * before**2 / 2
    off = -c.left - c.v_left * before
    sd = np.sqrt(np.maximum(c.sd_v**2 + c.restless * before - both**2 / way, 0.0))
    speed = np.maximum(c.v_left + both / way * off + sd * SPEEDS, 0.0)
    log_density = _log_stopped(c, speed, (1 - u[:, None]) * h) + np.log(np.maximum(speed, 1e-300))
    log_hit = np.logaddexp.reduce(log_density - SPEEDS**2 / 2, axis=1)
    return log_hit + _log_normal(off, 0.0, np.sqrt(way))[:, 0]


def _log_stopped(c: Crossing, speed: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Log likelihood of the compression `right` [m], `after` [s] a hit at this `speed` [m/s].

    The speed decays to v_right, on a way that is known only roughly: a hand that hits fast rebounds.
    """
    way = STOP * -np.expm1(-after / STOP) * (speed - c.v_right)
    sd = np.sqrt(c.sd_right**2 + (c.sd_v * after) ** 2 + (REBOUND * way) ** 2)
    return _log_normal(c.right, c.v_right * after + way, sd)


def _log_normal(x: np.ndarray | float, mean: np.ndarray | float, sd: np.ndarray) -> np.ndarray:
    """Log density of a normal distribution up to a constant."""
    return -0.5 * ((x - mean) / sd) ** 2 - np.log(sd)


def _minimum_jerk(phase: np.ndarray | float) -> np.ndarray | float:
    s = np.clip(phase, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _minimum_jerk_slope(phase: np.ndarray | float) -> np.ndarray | float:
    s = np.clip(phase, 0.0, 1.0)
    return 30 * s**2 * (1 - s) ** 2


def log_launch(c: Crossing, h: float, u: np.ndarray) -> np.ndarray:
    """Log likelihood of a launch at u: creep under load before, acceleration after.

    Under load the fingers creep by -left at the pace of the load, of which v_left is a noisy early reading;
    from then on they accelerate to v_right with constant jerk, as minimum-jerk motions start, so the distance
    covered is a third of that at full speed, give or take LAUNCH.
    """
    before, after = u * h, (1 - u) * h
    creep = np.clip(-c.left / before, 0.0, max(c.v_right, c.sd_v))
    gain = np.hypot(c.v_right - creep, c.sd_v)
    sd = np.sqrt(c.sd_right**2 + (c.sd_v * after / 3) ** 2 + (LAUNCH * gain * after) ** 2)
    log_after = _log_normal(c.right, (creep + (c.v_right - creep) / 3) * after, sd) + np.log(gain)
    return log_after + _log_normal(c.v_left, 0.75 * creep, np.hypot(c.sd_v, 0.25 * creep))


ONSET = 0.001  # prior: s; viscosity lets a pad's force lead its compression, by a few ms in foam
UNIFORM = 0.02  # prior: weight of a crossing anywhere in the interval, for whatever g leaves out


@dataclass(frozen=True, repr=False)
class BoundaryPosterior(Brief):
    """Posterior of one boundary: probabilities (M,) at increasing times (M,) [s]."""

    times: np.ndarray
    probabilities: np.ndarray

    def quantile(self, q: float) -> float:
        """Time [s] before which the boundary lies with probability q."""
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
    return BoundaryPosterior(mean + sd * ndtri(NODES), np.full(POINTS, 1 / POINTS))


def crossing_density(crossings: list[Crossing], width: float) -> np.ndarray:
    """Density (POINTS,), summing to 1, of the time in an interval of `width` s at which all have crossed.

    Several crossings are fingers that touch, and the boundary is the last of them; without any the density is
    uniform. Unseen for long, motions may begin and end otherwise.
    """
    if not crossings:
        return np.full(POINTS, 1.0 / POINTS)
    if crossings[0].kind == "impact":
        density = np.diff(last_impact(crossings, width), prepend=0.0)
    else:
        shapes = {"smooth": log_smooth, "landing": log_landing, "launch": log_launch}
        log_density = shapes[crossings[0].kind](crossings[0], width, NODES)
        density = np.exp(log_density - log_density.max())
    anywhere = 1 - (1 - UNIFORM) * np.exp(-max(width - MOTION[0], 0.0) / MOTION[1])
    return (1 - anywhere) * density / density.sum() + anywhere / POINTS


def evenly(t: np.ndarray, interval_probability: np.ndarray) -> BoundaryPosterior:
    """Boundary posterior given the probability (T-1,) of each interval, uniform within intervals.

    Intervals of probability below 1e-6 are omitted.
    """
    likely = np.flatnonzero(interval_probability > 1e-6)
    times = t[likely, None] + NODES * (t[likely + 1] - t[likely])[:, None]
    masses = np.repeat(interval_probability[likely], POINTS)
    return blurred(times.ravel(), masses, t[0], t[-1])


def blurred(
    times: np.ndarray, probabilities: np.ndarray, first: float, last: float, sd: float = ONSET
) -> BoundaryPosterior:
    """The posterior convolved with a normal distribution of this `sd` [s], by Gauss-Hermite nodes."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    spread = np.clip(times[:, None] + sd * nodes, first, last).ravel()
    mass = (probabilities[:, None] * weights).ravel()
    order = np.argsort(spread, kind="stable")
    return BoundaryPosterior(spread[order], mass[order] / mass.sum())
