"""Pads and timing as shown by the recording: compliance, and delay of forces against positions.

Before a block is lifted and after it is set down it rests, so the fingers' distance and height follow the
pads alone (`hmmseg.contact.equations`). Within one such stretch

    value(t - delay) = rest - compliance x load(t)

for the distance and the summed grip forces, or the height and the net vertical force. Nominal stiffnesses are
a prior; the delay is common to all forces (a clock offset, a filter; or, from foam's viscosity, a lead of its
damping over its stiffness). Each stretch has a compliance of its own; their spread is the form error of a
linear pad.

While both fingers press, the pads are compressed by what the distance falls short of the block's width,

    load(t) = max(width - distance(t), 0) / compliance,

from before the touch until after the release. A late sensor reports this `shift` s later, one with a
first-order filter smooths it with a time `constant`. Distances are joined by cubic Hermite pieces with the
measured speeds. Touches and releases, where the load changes most, are thus the most informative, and the
sharpness of the change distinguishes a filter from a delay. Widths follow from each hold; the compliance is
profiled under its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmmseg.contact.decompose import FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, pads_of
from hmmseg.errors_in_variables import slope_between
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.levels import SURE, TAIL, decisive
from hmmseg.robust import NORMAL, robust_sd, weighted_median
from hmmseg.segmentation.emissions import Parameters, channel_sd
from hmmseg.segmentation.stretches import (
    DEPENDENT,
    NONE,
    Stretch,
    Toe,
    find_toe,
    fit_slope,
    lagging,
    reading,
    ringing,
    steepest,
    stretches,
    trust,
)

STEP = 0.0025  # numerics: s; step at which distances and filters are evaluated
FINE = np.arange(-0.01, 0.0101, 0.001)  # numerics: s; delays of any hand: foams lead by some ms
SHIFTS = np.arange(0.015, 0.301, 0.005)  # prior: s; delays of a sensor, equally likely
CONSTANTS = np.array([0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1])  # prior: s; of its filter, alike
LEAD_SD = 0.003  # prior: s; of a delay that is not the sensor's: foams lead by a few ms at most
LATE_HANDS = 0.007  # prior: share of hands whose sensors delay their forces
ENOUGH = 24  # numerics: squeezes that determine a delay
PROBES = 8  # numerics: white noises that show how far joining and filtering average noise
COMPLIANCES = np.geomspace(0.33, 3.0, 17)  # numerics: multiples of the nominal compliance
NEAR = np.geomspace(0.75, 1.33, 49)  # numerics: multiples of the likeliest of these, under late forces
UNSTATED = np.geomspace(4e-5, 1.2e-3, 17)  # numerics: m/N; compliances of nominally rigid pads
LAW_SHARE, LAW_LEAD = 0.05, 0.0015  # prior: relative deviation of a pad's force from its law, and lead [s]
SOFT = 2e-4  # prior: m/N; sd of the compliance of nominally rigid pads
# chosen: share of a squeeze's firmest load above which the block is held; below it, soft pads still give
HOLD = 0.75
FIRMEST = 0.95  # numerics: quantile of the loads
SLOWEST_SD = 3e-5  # prior: m; noise of a distance that neither rig nor recording gives


@dataclass(frozen=True)
class Squeeze:
    """One grip on a resting block, with the free motion before and after it, arrays (N,).

    Times t [s], the fingers' distance [m] and its rate [m/s], the summed grip `load` [N], NaN while only one
    finger presses, and their noise.
    """

    t: np.ndarray
    distance: np.ndarray
    rate: np.ndarray
    load: np.ndarray
    sd_distance: float
    sd_load: float


def squeeze(s: Signals, start: float, end: float, p: Parameters) -> Squeeze | None:
    """The squeeze between `start` and `end` [s]; None if there are too few samples."""
    sd = p.force_sd(s)
    one, two = s.fx1 - p.bias[0], -(s.fx2 - p.bias[2])
    alone = (np.maximum(one, two) > SURE * sd) & (np.minimum(one, two) <= SURE * sd)
    rate = np.gradient(s.distance, s.t) if s.derived else s.vx2 - s.vx1
    use = (s.t >= start) & (s.t <= end) & np.isfinite(one + two + s.distance + rate)
    if use.sum() < 6 or not (~alone & use).any():
        return None
    noise = np.sqrt(2.0) * channel_sd(s.sd_x, s.x1)
    noise, load = noise if noise > 0 else SLOWEST_SD, np.where(alone, np.nan, one + two)
    return Squeeze(s.t[use], s.distance[use], rate[use], load[use], noise, np.sqrt(2.0) * sd)


@dataclass(frozen=True)
class Lateness:
    """Delay of the forces: `delay` [s], its sd, whether it is the sensor's, and whether by a filter.

    `compliance` [m/N] of a pad under such forces, and its sd.
    """

    delay: float = 0.0
    sd: float = LEAD_SD
    late: bool = False
    filter: bool = False
    compliance: tuple[float, float] = (0.0, SOFT)


def lateness(squeezes: Sequence[Squeeze], prior: tuple[float, float]) -> Lateness:
    """Delay of the forces; the sensor's if a long delay, or a filter, is decisively the better explanation.

    `prior`: mean and sd of the compliance of a pad [m/N], which is profiled.
    """
    some = squeezes[:: max(1, len(squeezes) // ENOUGH)]
    squeezes = [
        s for s in some if np.quantile(np.nan_to_num(s.load), FIRMEST) >= 0
    ]  # misread forces may pull
    if not squeezes:
        return Lateness()
    noises = [_noise(s.t) for s in squeezes]

    def likelihoods(compliances: np.ndarray, values: np.ndarray, filtered: bool) -> np.ndarray:
        """Log-likelihoods (C, len(values)) of compliances and shifts, or time constants of a filter [s]."""
        total = -(((compliances - prior[0]) / prior[1]) ** 2)[:, None] / 2
        for s, white in zip(squeezes, noises, strict=True):
            load, pace = _late(s.t, _loads(s, compliances), values, filtered)
            left = np.mean(_late(s.t, white, values, filtered) ** 2, axis=(0, 1))
            total = total + _log_likelihood(s, compliances, load, pace, left)
        return total

    compliances = prior[0] * COMPLIANCES if prior[0] > 0 else UNSTATED
    log_lead = -((FINE / LEAD_SD) ** 2) / 2
    usual = likelihoods(compliances, FINE, False) + log_lead - np.logaddexp.reduce(log_lead)
    families = [(values, likelihoods(compliances, values, filtered) - np.log(2 * values.size), filtered)
                for values, filtered in ((SHIFTS, False), (CONSTANTS, True))]  # fmt: skip
    evidence = [float(np.logaddexp.reduce(table.max(axis=0))) for _, table, _ in families]
    late = np.logaddexp.reduce(evidence) - np.logaddexp.reduce(usual.max(axis=0)) > decisive(LATE_HANDS)
    values, table, filtered = families[int(np.argmax(evidence))] if late else (FINE, usual, False)
    mean, sd = _moments(values, table.max(axis=0))
    if not late:
        return Lateness(mean, sd)
    near = compliances[table.max(axis=1).argmax()] * NEAR
    table = likelihoods(near, values, filtered)
    return Lateness(mean, sd, True, filtered, _moments(near, np.logaddexp.reduce(table, axis=1)))


def _moments(values: np.ndarray, log_weight: np.ndarray) -> tuple[float, float]:
    """Mean and sd of a quantity known at these values."""
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2 + np.min(np.diff(values)) ** 2 / 12))


def _loads(s: Squeeze, compliances: np.ndarray) -> np.ndarray:
    """Loads [N] and absolute rates, (2, num_compliances, num_steps), at each STEP from the first sample."""
    load = np.nan_to_num(s.load)
    holds = load >= HOLD * np.quantile(load, FIRMEST)
    width = np.median(s.distance[holds] + compliances[:, None] * load[holds], axis=1, keepdims=True)
    distance = _joined(s.t, s.distance, s.rate)
    load = np.maximum(width - distance, 0.0) / compliances[:, None]
    return np.stack([load, np.abs(np.gradient(load, STEP, axis=1))])


def _noise(t: np.ndarray) -> np.ndarray:
    """White noise of samples at t (N,) [s], joined as distances are, (PROBES, num_steps)."""
    white = np.random.default_rng(0).choice([-1.0, 1.0], (PROBES, t.size))
    return _joined(t, white, np.gradient(white, t, axis=1))


def _joined(t: np.ndarray, values: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Values (..., num_steps) at each STEP on cubic Hermite pieces through samples at t (N,) [s] and their
    rates, (..., N)."""
    clock = np.minimum(np.arange(t[0], t[-1] + STEP, STEP), t[-1])
    before = np.clip(np.searchsorted(t, clock, side="right") - 1, 0, t.size - 2)
    width = np.diff(t)[before]
    u = (clock - t[before]) / width
    left, right = values[..., before], values[..., before + 1]
    start, end = width * rates[..., before], width * rates[..., before + 1]
    bend = start + end - 2 * (right - left)
    return left + u * (start + u * (3 * (right - left) - 2 * start - end + u * bend))


def _late(t: np.ndarray, steps: np.ndarray, values: np.ndarray, filtered: bool) -> np.ndarray:
    """Signals (..., num_steps) at each STEP as read at t (N,), (..., N, M): shifted by each of M values [s],
    or `filtered` with these time constants."""
    if filtered:
        return lagging(steps, np.exp(-STEP / values), *_steps(t - t[0], steps.shape[-1]))
    place, share = _steps(np.clip(t[:, None] - values, t[0], t[-1]) - t[0], steps.shape[-1])
    return (1 - share) * steps[..., place] + share * steps[..., place + 1]


def _steps(clock: np.ndarray, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The STEP before each time [s] since the first, and its fraction of the way to the next."""
    place = np.minimum((clock / STEP).astype(int), num_steps - 2)
    return place, clock / STEP - place


def _log_likelihood(
    s: Squeeze, compliances: np.ndarray, load: np.ndarray, pace: np.ndarray, left: np.ndarray
) -> np.ndarray:
    """Log-likelihoods (C, M) of one squeeze, given loads and rates (C, N, M); Student-t.

    The distance's noise contributes only to loads that press. Between samples, and by a filter, it is
    averaged to a share `left` (M,) of its variance, which makes residuals smaller but no delay likelier.
    Neither is a compliance for the noise that it makes of distances: the mean of forces given distances and
    of distances given forces (Frisch 1934).
    """
    there = np.isfinite(s.load)
    force, load, pace = s.load[there][:, None], load[:, there], pace[:, there]
    noise = (s.sd_distance / compliances[:, None, None]) ** 2 * (load > s.sd_load)
    known = s.sd_load**2 + (LAW_SHARE * load) ** 2 + (LAW_LEAD * pace) ** 2
    apart = (force - load) ** 2 / (known + left * noise)
    total = ((TAIL + 1) * np.log1p(apart / TAIL) + np.log(known + noise)).sum(axis=1)
    return -DEPENDENT / 2 * (total + (force > s.sd_load).sum() * np.log(compliances)[:, None])


STIFFNESS_SD = 0.3  # prior: relative sd of a stiffness if the rig gives none: foams of one make differ so
RIGID = 2e-5  # chosen: m/N; a stiffer pad hides its compression from any force sensor
FORM, FORM_STRETCHES = 0.05, 4.0  # prior: usual form error of foam, worth this many stretches
BETWEEN = 0.15  # prior: share of a sample interval by which corrected forces may be off in time
REACH = 0.4  # numerics: s of free motion used before and after a hold: the longest delay, and a touch
LATE_SHARE = 0.1  # prior: relative error of a delay: a filter of another order, or a mixture with a shift
LARGEST = 0.9  # chosen: quantile over all contacts that represents the largest friction, or ringing


@dataclass(frozen=True)
class Compliance:
    """Compliance [m/N], its standard deviation, and its relative variation between contacts (`form`).

    `toe`: additional give of hardly pressed contacts.
    """

    value: float
    sd: float
    form: float
    toe: Toe = NONE

    @property
    def doubt(self) -> float:
        """Relative standard deviation, at most 1."""
        return min(self.sd / self.value, 1.0) if self.value > 0 else 0.0


@dataclass(frozen=True)
class Sensing:
    """Pads and force delay of one hand, as its recordings show them.

    `delay` [s] of the forces (negative: they lead) and its sd `delay_sd`. If it is the sensor's (`late`),
    forces must be read `delay` later or, for a `filter`, unfiltered. `friction`: largest ratio of shear to
    grip force observed on one pad as it lets go. `rests` [m]: residuals of the heights of resting blocks,
    given their loads, and the `noise` of heights [m] and loads [N].
    """

    normal: Compliance
    shear: Compliance
    delay: float
    delay_sd: float
    late: bool = False
    filter: bool = False
    friction: float = np.inf
    rests: np.ndarray = field(default_factory=lambda: np.zeros(0))
    noise: tuple[float, float] = (SLOWEST_SD, 0.0)

    @property
    def pads(self) -> Pads:
        """Alike for both fingers."""
        return Pads(self.normal.value, self.normal.value, self.shear.value, self.shear.value)

    def heights_gain(self, other: Sensing) -> float:
        """Log-likelihood gain [nats] of the heights of resting blocks over another reading of the forces.

        Misfits count relative to their expected noise, since forces without their filter are louder.
        """
        if not (self.rests.size and other.rests.size):
            return np.inf
        own, others = (
            robust_sd(s.rests) / np.hypot(s.noise[0], self.shear.value * s.noise[1]) for s in (self, other)
        )
        return DEPENDENT * self.rests.size * float(np.log(others / own))

    def remarks(self, rig: Rig) -> tuple[str, ...]:
        """Contradictions between recording and rig, for people."""
        out = []
        if self.late:
            how = "are filtered with a time constant of" if self.filter else "come late by"
            out.append(f"forces {how} {1e3 * self.delay:.0f} ms against positions; boundaries allow for it")
        nominal, found = pads_of(rig).normal1, self.normal
        if abs(found.value - nominal) > max(SURE * found.sd, STIFFNESS_SD * nominal):
            stated = f"rig.toml says {1e6 * nominal:.0f}" if nominal > 0 else "rig.toml states none"
            out.append(f"the pads give {1e6 * found.value:.0f} um/N along the grip, where {stated}; "
                       "boundaries allow for it")  # fmt: skip
        return tuple(out)


def read_again(s: Signals, sensing: Sensing) -> Signals:
    """Signals with the delay of the forces removed, or their filter undone."""
    if not sensing.late:
        return s
    forces, louder = {}, 1.0
    for name in ("fx1", "fy1", "fx2", "fy2"):
        force = getattr(s, name)
        there = np.isfinite(force)
        if sensing.filter:
            forces[name] = np.full_like(force, np.nan)
            forces[name][there], louder = _unfiltered(s.t[there], force[there], sensing.delay)
        else:
            forces[name] = resampled(s.t + sensing.delay, s.t[there], force[there])
    return replace(s, **forces, sd_force=s.sd_force * louder)


def _unfiltered(t: np.ndarray, force: np.ndarray, constant: float) -> tuple[np.ndarray, float]:
    """Forces [N] without their first-order filter of this time `constant` [s], and the noise gain.

    (F(t) - k F(t - span)) / (1 - k), where k is the share kept over the span, is a mean input over the span,
    or a steadily changing one at a time constant - span k / (1 - k) earlier. From sample to sample, noise of
    fast recordings would be many times louder; a span that keeps half makes it sqrt(5) times louder at most.
    """
    span = max(float(np.median(np.diff(t))), np.log(2) * constant)
    kept = np.exp(-span / constant)
    read = (force - kept * np.interp(t - span, t, force)) / (1 - kept)
    ago, louder = constant - span * kept / (1 - kept), float(np.sqrt(1 + kept**2) / (1 - kept))
    return resampled(t, t - ago, read), louder


def resampled(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Readings (num_samples,) at t [s] evaluated `at` other times, NaN beyond the last.

    Each is extrapolated from its nearest neighbour with the lesser of the slopes on either side, if they
    agree in sign, so that a jump is not smeared over the samples before it (the minmod limiter; van Leer
    1979).
    """
    slopes = np.diff(values) / np.diff(t)
    before, after = np.r_[slopes[:1], slopes], np.r_[slopes, slopes[-1:]]
    slope = np.where(before * after > 0, np.where(np.abs(before) < np.abs(after), before, after), 0.0)
    right = np.clip(np.searchsorted(t, at), 1, t.size - 1)
    nearest = np.where(at - t[right - 1] <= t[right] - at, right - 1, right)
    out = values[nearest] + slope[nearest] * (at - t[nearest])
    return np.where(at > t[-1] + (t[-1] - t[-2]) / 2, np.nan, out)


def sense(
    signals: Sequence[Signals], paths: Sequence[tuple[np.ndarray, np.ndarray]], steps: Sequence[Subtask],
    parameters: Parameters, rig: Rig, again: bool = False,
) -> Sensing:  # fmt: skip
    """Pads and delay from aligned recordings.

    `again`: the forces were re-read, so no long delay remains. `paths`: per recording the times [s] and
    subtasks (num_timesteps,) of its alignment.
    """
    grips, loads, squeezes = list[Stretch](), list[Stretch](), list[Squeeze | None]()
    ratios, rings = list[float](), list[tuple[float, float, float]]()
    for s, (t, path) in zip(signals, paths, strict=True):
        for step in steps:
            if step.state == ON_GROUND and (path == step.index).sum() > 1:
                own = np.flatnonzero(path == step.index)
                start, end = float(t[max(own[0] - 1, 0)]), float(t[min(own[-1] + 1, t.size - 1)])
                grip, load = stretches(s, start, end, parameters.weight[str(step.object)], parameters)
                grips += [] if grip is None else [grip]
                loads += [] if load is None else [load]
                ratios += steepest(s, start, end, parameters)
                rings += ringing(s, start, end, parameters)
                if not again:
                    squeezes.append(squeeze(s, *_with_free_motion(t, path, steps, step.index), parameters))
    rung = np.quantile(rings, LARGEST, axis=0) if rings else np.zeros(3)
    felt = [replace(q, sd_load=float(np.hypot(q.sd_load, rung[2]))) for q in squeezes if q is not None]
    nominal = pads_of(rig)
    priors = [_prior(nominal.normal1, max(rig.systematic.pad_stiffness)),
              _prior(nominal.shear1, max(rig.systematic.pad_stiffness))]  # fmt: skip
    timing, toe = lateness(felt, priors[0]), NONE
    lead, unknown = 0.0 if timing.late else timing.delay, timing.sd
    if not again:  # corrected forces, or a wrist's, are too coarse for a toe
        toe = find_toe([(*reading(s, lead)[:2], s.sd) for s in grips])
        if toe is not NONE:  # a toe explains an apparent delay
            grips, lead = [replace(s, toe=toe) for s in grips], 0.0
            timing = timing if timing.late else Lateness()
    normal, shear = (
        _compliance([_while_moving(s, lead, unknown) for s in own], prior, float(r))
        for own, prior, r in zip((grips, loads), priors, rung[:2], strict=True)
    )
    # Late loads of a stretch are not those of its places.
    normal = Compliance(*timing.compliance, FORM) if timing.late else replace(normal, toe=toe)
    between = BETWEEN * float(np.median([np.median(np.diff(s.t)) for s in signals])) if timing.late else 0.0
    doubt = float(np.sqrt(timing.sd**2 + (LATE_SHARE * timing.delay * timing.late) ** 2 + between**2))
    friction = float(np.quantile(ratios, LARGEST)) if ratios else np.inf
    heights = [
        place + shear.value * load for load, place, _ in (reading(s, lead) for s in loads) if load.size > 3
    ]
    rests = np.concatenate([np.zeros(0), *(height - np.median(height) for height in heights)])
    noise = (float(np.median([own.sd for own in loads] or [SLOWEST_SD])),
             float(np.median([parameters.force_sd(s) for s in signals] or [0.0]) / np.sqrt(2)))  # fmt: skip
    return Sensing(normal, shear, timing.delay, doubt, timing.late, timing.filter, friction, rests, noise)


def _prior(compliance: float, stated: float) -> tuple[float, float]:
    return compliance, (stated or STIFFNESS_SD) * compliance if compliance > 0 else SOFT


def _with_free_motion(
    t: np.ndarray, path: np.ndarray, steps: Sequence[Subtask], index: int
) -> tuple[float, float]:
    """Ends [s] of a hold extended into adjacent free motion, as a touch may precede its forces."""
    ends = []
    for adjacent, end, way in ((index - 1, 0, -1), (index + 1, -1, 1)):
        near = float(t[np.flatnonzero(path == index)[end]])
        free = t[path == adjacent] if 0 <= adjacent < len(steps) and steps[adjacent].state == FREE else t[:0]
        far = near + way * REACH
        ends.append(float(np.clip(far, free[0], free[-1])) if free.size else near)
    return ends[0], ends[1]


def _while_moving(s: Stretch, lead: float, doubt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loads, places and their noise (M,): moving, these are off by what is unknown of the delay [s]."""
    load, place, pace = reading(s, lead)
    return load, place, np.hypot(s.sd, pace * doubt)


def _compliance(
    readings: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray | float]], prior: tuple[float, float],
    ringing: float = 0.0,
) -> Compliance:  # fmt: skip
    """Common compliance of all stretches, each with its own rest; `prior`: mean and sd [m/N].

    `ringing` [N]: known noise of the loads.
    """
    slopes = np.array([_slope(*one, ringing) for one in readings]).reshape(-1, 3)
    c, w, apart = slopes[slopes[:, 1] > 0].T
    if not c.size:
        return Compliance(prior[0], prior[1], FORM)
    middle = weighted_median(c, w)
    # Scatter of stretches beyond what noise explains, by a robust method of moments.
    spread = NORMAL * weighted_median(np.abs(c - middle), w)
    between = max(spread**2 - 1 / float(np.median(w)), 0.0) if c.size > 1 else 0.0
    usual = FORM * max(abs(middle), prior[0])
    between = (c.size * between + FORM_STRETCHES * usual**2) / (c.size + FORM_STRETCHES)
    trusted = (TAIL + 1) / (TAIL + (c - middle) ** 2 / (1 / w + between)) / (1 / w + between)
    # Ringing biases all stretches alike, which no number of them averages out.
    seen = float(trusted @ c / trusted.sum())
    information = 1 / (1 / trusted.sum() + float(trusted @ apart / trusted.sum()) ** 2)
    total = information + prior[1] ** -2
    value = float(max((information * seen + prior[0] * prior[1] ** -2) / total, 0.0))
    return Compliance(value, float(total**-0.5), float(np.sqrt(between)) / max(value, RIGID))


def _slope(
    load: np.ndarray, place: np.ndarray, sd: np.ndarray | float, ringing: float
) -> tuple[float, float, float]:
    """Compliance [m/N] of one stretch, its information, and its error in common with other stretches.

    Loads that ring, by at least `ringing` [N], while nothing moves flatten the line of places over loads, in
    the worst case to zero (`slope_between`).
    """
    slope, weight = fit_slope(load, place, sd)
    if weight == 0:
        return slope, 0.0, 0.0
    own, least = trust(sd, load.size), float(np.min(sd))
    root = np.sqrt(own)
    x, y = root * (load - np.average(load, weights=own)), root * (np.average(place, weights=own) - place)
    square, free = float(x @ x), load.size - 2.0
    middle, apart = slope_between(square, float(x @ y), float(y @ y), free, (ringing, least))
    if not np.isfinite(apart):
        return middle, 0.0, 0.0
    value = middle if apart else slope
    sampling = float(((y - value * x) ** 2).sum()) / free * square / (square - free * ringing**2) ** 2
    return value, float(1.0 / (max(1.0 / weight, sampling) + apart**2)), apart
