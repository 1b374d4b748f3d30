"""Do forces come late? The grip as the fingers' distance predicts it, delayed or filtered, is compared.

While both fingers press, the pads give what the distance falls short of the block's width,

    load(t) = max(width - distance(t), 0) / compliance,

from before the touch until after the release. A sensor that is late shows this `shift` s later, one with
a first-order filter smoothed by a time `constant`. Distances are joined by cubic Hermite pieces with the
measured speeds. So touches and releases, where load changes most, say most, and a filter is told from a
delay by how sharp they are. Widths follow from each hold, the compliance is profiled under its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.levels import TAIL
from hmmseg.segmentation.emissions import Parameters
from hmmseg.segmentation.features import noise_sd
from hmmseg.segmentation.lagging import lagging
from hmmseg.segmentation.stretches import SIGNIFICANT
from hmmseg.segmentation.toe import DEPENDENT

STEP = 0.0025  # numerics: s; distances and filters are evaluated at such steps
SHIFTS = np.arange(-0.01, 0.301, 0.005)  # prior: s; delays that are tried, alike; foams lead by some ms
CONSTANTS = np.array([0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1])  # prior: s; filters
COMPLIANCES = np.geomspace(0.33, 3.0, 17)  # numerics: times what the rig says
UNSTATED = np.geomspace(4e-5, 1.2e-3, 17)  # numerics: m/N; of pads that are said to be rigid
FORM, ONSET = 0.05, 0.0015  # prior: share by which a pad's force is off its law, and s by which it leads
HOLD = 0.75  # chosen: share of a squeeze's firmest load from which it holds its block
FIRMEST = 0.95  # numerics: quantile
SLOWEST_SD = 3e-5  # prior: m; noise of a distance that neither rig nor recording tells


@dataclass(frozen=True)
class Squeeze:
    """One grip on a block at rest with the free motion beside it, arrays (N,).

    Times t [s], the fingers' distance [m] and its rate [m/s], the summed grip `load` [N], NaN where one
    finger presses alone, and their noise.
    """

    t: np.ndarray
    distance: np.ndarray
    rate: np.ndarray
    load: np.ndarray
    sd_distance: float
    sd_load: float


def squeeze(s: Signals, start: float, end: float, p: Parameters) -> Squeeze | None:
    """The squeeze between `start` and `end` [s]; None without samples enough."""
    sd = p.scale["force"] if np.isnan(s.sd_force) else s.sd_force
    one, two = s.fx1 - p.bias[0], -(s.fx2 - p.bias[2])
    alone = (np.maximum(one, two) > SIGNIFICANT * sd) & (np.minimum(one, two) <= SIGNIFICANT * sd)
    rate = np.gradient(s.distance, s.t) if s.derived else s.vx2 - s.vx1
    use = (s.t >= start) & (s.t <= end) & np.isfinite(one + two + s.distance + rate)
    if use.sum() < 6 or not (~alone & use).any():
        return None
    known = s.sd_x[np.isfinite(s.sd_x)]
    noise = np.sqrt(2.0) * (float(np.median(known)) if known.size else noise_sd(s.x1))
    load = np.where(alone, np.nan, one + two)
    return Squeeze(
        s.t[use], s.distance[use], rate[use], load[use], noise if noise > 0 else SLOWEST_SD, np.sqrt(2.0) * sd
    )


@dataclass(frozen=True)
class Lateness:
    """How late forces are: `delay` [s], its standard deviation, and whether it is a filter's time constant.

    `gain`: nats by which that explains the recording better than a lead or a delay below `least`.
    """

    delay: float
    sd: float
    filter: bool
    gain: float


def lateness(squeezes: Sequence[Squeeze], prior: tuple[float, float], least: float) -> Lateness | None:
    """The delay, or filter, that explains the forces best; None where there is nothing to tell it by.

    `prior`: mean and sd of the compliance of a pad [m/N]. `least` [s]: what is less is no delay.
    """
    if not squeezes:
        return None
    compliances = prior[0] * COMPLIANCES if prior[0] > 0 else UNSTATED
    cost = ((compliances - prior[0]) / prior[1]) ** 2 / 2
    loads = [_loads(s, compliances) for s in squeezes]
    shifted = -cost[:, None] + sum(map(_log_shifted, squeezes, repeat(compliances), loads))
    filtered = -cost[:, None] + sum(map(_log_filtered, squeezes, repeat(compliances), loads))
    families = ((SHIFTS, shifted.max(axis=0)), (CONSTANTS, filtered.max(axis=0)))
    none = families[0][1][least >= SHIFTS].max()
    found = []
    for which, (values, log_likelihood) in enumerate(families):
        weight = np.exp(log_likelihood - log_likelihood.max())
        weight /= weight.sum()
        mean = float(weight @ values)
        sd = float(np.sqrt(weight @ (values - mean) ** 2 + np.min(np.diff(values)) ** 2 / 12))
        found.append(Lateness(mean, sd, bool(which), float(log_likelihood.max() - none)))
    return max(found, key=lambda one: one.gain)


def _log_shifted(s: Squeeze, compliances: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Log-likelihoods (num_compliances, num_shifts) of one squeeze."""
    clock = np.clip(s.t[:, None] - SHIFTS, s.t[0], s.t[-1])
    load, pace = _at(loads, clock - s.t[0])
    return _log_likelihood(s, compliances, load, pace)


def _log_filtered(s: Squeeze, compliances: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Log-likelihoods (num_compliances, num_constants) of one squeeze."""
    with np.errstate(divide="ignore"):
        kept = np.exp(-STEP / CONSTANTS)
    load, pace = lagging(loads, kept, *_steps(s.t - s.t[0], loads.shape[-1]))
    return _log_likelihood(s, compliances, load, pace)


def _loads(s: Squeeze, compliances: np.ndarray) -> np.ndarray:
    """Loads [N], and their rates, (2, num_compliances, num_steps) at each STEP from the first sample on."""
    there = np.nan_to_num(s.load)
    holds = there >= HOLD * np.quantile(there, FIRMEST)
    width = np.median(s.distance[holds] + compliances[:, None] * there[holds], axis=1, keepdims=True)
    clock = np.minimum(np.arange(s.t[0], s.t[-1] + STEP, STEP), s.t[-1])
    distance = _joined(s, clock)
    load = np.maximum(width - distance, 0.0) / compliances[:, None]
    return np.stack([load, np.abs(np.gradient(load, STEP, axis=1))])


def _joined(s: Squeeze, clock: np.ndarray) -> np.ndarray:
    """Distances [m] at times [s] of cubic Hermite pieces through the samples with their rates."""
    before = np.clip(np.searchsorted(s.t, clock, side="right") - 1, 0, s.t.size - 2)
    width = np.diff(s.t)[before]
    u = (clock - s.t[before]) / width
    left, right = s.distance[before], s.distance[before + 1]
    start, end = width * s.rate[before], width * s.rate[before + 1]
    bend = start + end - 2 * (right - left)
    return left + u * (start + u * (3 * (right - left) - 2 * start - end + u * bend))


def _steps(clock: np.ndarray, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The STEP before each time [s] since the first, and how far it is on the way to the next."""
    place = np.minimum((clock / STEP).astype(int), num_steps - 2)
    return place, clock / STEP - place


def _at(values: np.ndarray, clock: np.ndarray) -> np.ndarray:
    """Values (..., num_steps) at times [s] since the first of them, linear between two."""
    place, share = _steps(clock, values.shape[-1])
    return (1 - share) * values[..., place] + share * values[..., place + 1]


def _log_likelihood(s: Squeeze, compliances: np.ndarray, load: np.ndarray, pace: np.ndarray) -> np.ndarray:
    """Log-likelihoods (C, M) of the forces of one squeeze, given loads and their rates (C, N, M); Student-t.

    What a distance's noise makes of a load counts where there is one.
    """
    there = np.isfinite(s.load)
    load, pace = load[:, there], pace[:, there]
    noise = (s.sd_distance / compliances[:, None, None]) ** 2 * (load > s.sd_load)
    variance = s.sd_load**2 + noise + (FORM * load) ** 2 + (ONSET * pace) ** 2
    apart = (s.load[there][:, None] - load) ** 2 / variance
    return -DEPENDENT / 2 * ((TAIL + 1) * np.log1p(apart / TAIL) + np.log(variance)).sum(axis=1)
