"""The gap of aligned trials as input of an attribution: whitened rows, nuisances, linear candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.fft import dct
from scipy.stats import norm

from hmmseg.io.rig import Tolerance
from simgap.attribution.heldout import POSITIVE, RESPONSE
from simgap.attribution.posterior import STATED
from simgap.attribution.problem import BANDS, MODELLED, Candidate, Gap, Rows, cosines
from simgap.effects import catalogue, name_of
from simgap.gap.frame import CHANNELS
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import (
    Fitted,
    Problem,
    columns_of,
    evaluated,
    free_of,
    residual_at,
    slots,
    tolerated,
)
from simgap.gap.sensor_noise import MEDIAN
from simgap.phases import Phase

# Effects that scatter residuals instead of shifting them: the variance they add, and their size.


@dataclass(frozen=True)
class Scatter:
    """A random effect.

    Attributes:
        effect: Its name.
        value: Its size.
        log_sd: Standard deviation of the log of its size.
        variance: Variance (n,) over the noise's that it adds to each cosine coefficient, in the order of
            `rows_of`.
        known: Log evidence of another kind [nats].
        same: Whether its size is the same everywhere.
        frees: Most additional variance (n,) of each coefficient, whatever the size.
    """

    effect: str
    value: float
    log_sd: float
    variance: np.ndarray
    known: float = 0.0
    same: bool = True
    frees: np.ndarray | None = None


def on_grid(
    effect: str, nats: np.ndarray, unit: np.ndarray, grid: np.ndarray, spread: float = 0.0
) -> Scatter:
    """The most likely size of a random effect whose variance is size^2 `unit`.

    An imitation has a size at the end of the grid, or different sizes in the parts by a Bayes factor of
    POSITIVE.

    Args:
        effect: Its name.
        nats: Log likelihood (S, P) of each part's residuals at each size, minus that without the effect; a
            single cause has the same size in all parts.
        unit: Variance (n,) at size 1.
        grid: Sizes (S,).
        spread: Standard deviation of the log size between parts.
    """
    score = nats.sum(1)
    best, weight = int(score.argmax()), np.exp(score - score.max())
    centre = np.average(np.log(grid), weights=weight)
    sd = max(float(np.sqrt(np.average((np.log(grid) - centre) ** 2, weights=weight))), 1e-3)
    known = float(np.log(np.mean(weight)))  # cost of the unknown size: uniform over the grid
    several = (np.logaddexp.reduce(nats, axis=0) - np.log(grid.size)).sum()
    if spread > 0:
        near = norm.logpdf(np.log(grid), np.log(grid)[:, None], spread)
        near -= np.logaddexp.reduce(near, axis=1, keepdims=True)
        nats = np.logaddexp.reduce(near[:, :, None] + nats, axis=1)
    one = np.logaddexp.reduce(nats.sum(1)) - np.log(grid.size)
    same = best < grid.size - 1 and bool(one > several - POSITIVE)
    return Scatter(effect, float(grid[best]), sd, grid[best] ** 2 * unit, known, same)


def scatters(given: Problem, residual: np.ndarray, names: list[str]) -> list[Scatter]:
    """The scatter of each of the named effects in residuals (n,), nuisances included, if there is any."""
    known = (e.scatter for n, e in catalogue().items() if n in names and e.scatter is not None)
    return [s for scatter in known if (s := scatter(given, residual)) is not None]


# Level and colour of a recording's noise, estimated where nothing but noise is expected.
#
# The residual of a velocity averages three samples of velocity and differences three of position, so its
# noise is not white: at low frequency it has (4 + 2 cos w)^2 / 36 of the velocity's density and sin(w)^2 of
# the position's. In addition, sensors of one kind may be louder than stated and remember their last error
# (AR(1)). Level and colour of each kind maximise the likelihood of the median squares in some frequency
# bands: in free motion for forces, at rest for velocities, in grips for positions. Medians ignore local
# effects.

KINDS = (("x", "y", "distance", "offset"), ("vx", "vy"), ("fx", "fy", "grip", "shear"))
LEVELS = np.linspace(0.6, 1.5, 37)  # prior: noise over the stated one; more is an effect
COLOURS = np.linspace(0.0, 0.4, 9)  # prior: correlation from sample to sample; more is an effect
NOISE_BANDS = 6  # numerics: bands whose medians are taken
SLOWEST = 1.0  # chosen: Hz; slower motion shows effects rather than noise
OUTLIER = 8.0  # chosen: nats; most that a band costs, as an effect may fill it
FEWEST = 12  # numerics: fewest coefficients of a band
# numerics: variance of residuals over that of noise alone, above which they do not show the noise
CLEAN = 1.25


def with_noise(given: Problem, rows: Rows, residual: np.ndarray) -> Rows:
    """Set the noise's standard deviation and shape in each cosine coefficient of the rows' cells."""
    turn, frequency = _places(rows)
    shape = _shape(given, rows, turn)
    square = cosines(rows, residual[:, None])[0][:, 0] ** 2 / shape
    arrays = given.frame.arrays
    there = given.there
    doubt = np.square(arrays.sd[there] / arrays.plain[there])
    sure = (np.bincount(rows.cell, doubt) < CLEAN * np.bincount(rows.cell))[rows.cell]
    phase = arrays.phase.argmax(-1)[..., None].repeat(len(CHANNELS), -1)[there]
    still = np.isin(phase, (Phase.PICKUP, Phase.PLACE))
    variance = shape.copy()
    # Moving hands do more within a sample than differences show: their velocities have another noise.
    for names, at, quiet in (
        (KINDS[0], True, True), (KINDS[1], still, True), (KINDS[1], ~still, True),
        (KINDS[2], True, phase == Phase.FREE),
    ):  # fmt: skip
        mine = np.isin(rows.channel, [CHANNELS.index(n) for n in names]) & at
        seen = mine & sure & (frequency > SLOWEST) & quiet
        level, colour = _likeliest(turn[seen], square[seen])
        variance[mine] *= level**2 * _density(turn[mine], colour)
    return replace(rows, sd=np.sqrt(variance), shape=shape)


def _places(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Radians per sample and frequency [Hz] of each coefficient (n,)."""
    turn, frequency = np.zeros(rows.cell.size), np.zeros(rows.cell.size)
    for mine in rows.by_cell():
        turn[mine] = np.pi * np.arange(mine.size) / mine.size
        if mine.size > 1:
            frequency[mine] = turn[mine] / (2 * np.pi * np.median(np.diff(rows.time[mine])))
    return turn, frequency


def _shape(given: Problem, rows: Rows, turn: np.ndarray) -> np.ndarray:
    """Density (n,) of the residuals' stated noise over that of white noise of the same variance."""
    arrays, t = given.frame.arrays, given.frame.world.t
    step = float(np.median(np.diff(t[0])))
    out = np.ones(turn.size)
    for place, speed in (("x", "vx"), ("y", "vy")):
        p, v = (arrays.sample[..., CHANNELS.index(n)] for n in (place, speed))
        shaken = float(np.median(np.square(p / step) / np.square(v)))
        mine = rows.channel == CHANNELS.index(speed)
        w = turn[mine]
        out[mine] = 2 * (np.square((4 + 2 * np.cos(w)) / 6) + shaken * np.square(np.sin(w))) / (1 + shaken)
    return np.maximum(out, 0.02)


def _density(turn: np.ndarray | float, colour: float | np.ndarray) -> np.ndarray:
    """Spectral density of AR(1) noise of unit variance."""
    return (1 - colour**2) / (1 - 2 * colour * np.cos(turn) + colour**2)


def _likeliest(turn: np.ndarray, square: np.ndarray) -> tuple[float, float]:
    """Most likely level and colour of coefficients at `turn` [rad per sample] with these squares."""
    at = np.minimum((turn / np.pi * NOISE_BANDS).astype(int), NOISE_BANDS - 1)
    score = -0.5 * np.square(2 * np.log(LEVELS)[:, None] / STATED) + np.zeros(COLOURS.size)
    for band in range(NOISE_BANDS):
        mine = at == band
        if mine.sum() < FEWEST:
            continue
        seen = np.log(max(float(np.median(square[mine])) / MEDIAN, 1e-9))
        expected = 2 * np.log(LEVELS)[:, None] + np.log(_density(float(np.mean(turn[mine])), COLOURS))
        # The relative error of the median of n squares is 2.33 / sqrt(n).
        score = score - np.minimum(0.5 * np.square(seen - expected) * mine.sum() / 2.33**2, OUTLIER)
    level, colour = np.unravel_index(int(score.argmax()), score.shape)
    return float(LEVELS[level]), float(COLOURS[colour])


# How sensor noise affects fitted candidates: they are evaluated on recordings with a little more noise.
#
# `simgap.attribution.posterior` subtracts the effect from the products of their columns.

Other = TypeVar("Other")

# numerics: signs of draws by place; products of noise at different places cancel over the draws
SIGNS = np.array([[1, 1], [1, -1]], float)
SIZES = (1.0, -0.25)  # numerics: sds of noise in a draw; two sizes show whether its effect is proportional
ALIKE = 0.5  # numerics: largest difference of the two, as a share of the larger


def redrawn(given: Problem) -> tuple[Problem, ...]:
    """The problem with other noise on the recordings: for each draw one with each of SIZES.

    Every number is shifted by its sensor's standard deviation, up or down. Signs of neighbouring samples and
    of neighbouring channels are orthogonal over the draws, so that squares of their combinations have their
    expectation without scatter. If forces were rounded, a last draw is without the errors that they show.
    """
    world, sensor = given.frame.world, given.frame.arrays.sensor
    place = (np.arange(world.t.shape[1])[:, None] + np.arange(4)) % len(SIGNS)
    rng = np.random.default_rng(0)
    noise = {
        name: sensor[..., [k]] * rng.choice((-1.0, 1.0), (*world.t.shape, 4))
        for k, name in enumerate(("joints", "rates", "force"))
    }
    draws = [{n: signs[place] * each for n, each in noise.items()} for signs in SIGNS.T]
    draws += [{"force": -given.frame.rounding_errors}] if given.frame.step else []
    out = []
    for draw in draws:
        for size in SIZES:
            shaken = world._replace(**{n: getattr(world, n) + size * each for n, each in draw.items()})
            out.append(with_nuisances(replace(given, frame=replace(given.frame, world=shaken))))
    return tuple(out)


def carried(columns: np.ndarray, others: Sequence[Other], on: Callable[[Other], np.ndarray]) -> np.ndarray:
    """Errors (D, n, M) that noise causes in columns (n, M); products of noise are sums over D.

    Zero where it is not proportional to the noise, as next to a contact that the noise makes or breaks.

    Args:
        columns: The columns on the recordings.
        others: Redrawn recordings.
        on: Gives the columns on one of them.
    """
    out = []
    for k, pair in enumerate(zip(others[::2], others[1::2], strict=True)):
        one, other = ((on(each) - columns) / size for each, size in zip(pair, SIZES, strict=True))
        alike = np.abs(one - other) <= ALIKE * np.maximum(np.abs(one), np.abs(other))
        usual = 1 / np.sqrt(len(SIGNS.T)) if k < len(SIGNS.T) else 1.0
        out.append(np.where(alike, usual * (one + other) / 2, 0.0).astype(np.float32))
    return np.stack(out)


def _spectra(rows: Rows, noise: np.ndarray) -> np.ndarray:
    """Spectra of the errors of `carried`, over the noise's standard deviation.

    Sensor noise was redrawn white, of the stated size; rounding is as it was.
    """
    out = np.empty_like(noise)
    for k, draw in enumerate(noise):
        out[k] = cosines(rows, draw.astype(float), rows.shape if k < len(SIGNS.T) else None)[0]
    return out


def on_other(other: Problem, f: Fitted, usual: np.ndarray | None = None) -> Fitted:
    """Evaluate a fit at the same coordinates on another recording.

    `usual` are the derivatives with respect to the properties, if known.
    """
    return evaluated(other, f.effects, f.u, f.columns, usual)


# chosen: squared residual [noise's] from a usual error of a property, above which it shows at all
SHOWN = 1.0


def rows_of(given: Problem) -> Rows:
    """What each residual is; cells are in order of time."""
    frame = given.frame
    trial, sample, channel = np.nonzero(given.there)
    return Rows(
        trial, channel, frame.arrays.subtask[trial, sample], frame.world.t[trial, sample],
        frame.files, CHANNELS, tuple(f"{k}:{s.label}" for k, s in enumerate(frame.steps)), BANDS,
    )  # fmt: skip


def gap_of(
    given: Problem,
    healthy: Fitted,
    fits: Sequence[Fitted],
    scatters: Sequence[Scatter] = (),
    redrawn: Sequence[Problem] = (),
) -> Gap:
    """The gap with a candidate for every fit (of one effect each), scatter, and property measured apart.

    Args:
        given: The problem.
        healthy: Its fit without effects.
        fits: Fits of one effect each.
        scatters: Random effects.
        redrawn: Recordings with additional noise, which show how noise affects the candidates.
    """
    rows = with_noise(given, rows_of(given), given.nuisances.left(healthy.residual))
    usual = given.frame.rig.tolerance == Tolerance()
    scattering, tolerance = [_scattering(s, rows) for s in scatters], tolerated(given)
    # Decided here once: with additional noise on the recordings others might show.
    measured = _measured(given, healthy)
    seen = {c.parameters for c in measured if np.square(c.jacobian * c.scale).sum() > SHOWN}

    def at(problem: Problem, healthy: Fitted, fits: Sequence[Fitted]) -> Gap:
        nuisance = np.concatenate([-healthy.jacobian, problem.nuisances.columns], 1)
        shifting = [_shifting(problem, f, healthy) for f in fits]
        measured = [c for c in _measured(problem, healthy) if c.parameters in seen]
        every = (*shifting, *scattering, *measured)
        residual = _at_nominal(healthy, healthy)
        return Gap(rows, residual, nuisance, every, tolerance=tolerance, usual=usual)

    gap = at(given, healthy, fits)
    if not redrawn:
        return gap

    def on(other: Problem) -> np.ndarray:
        plain = on_other(other, healthy)
        return at(other, plain, [on_other(other, f, plain.jacobian) for f in fits]).raw_columns

    return replace(gap, carried=_spectra(rows, carried(gap.raw_columns, redrawn, on)))


def _measured(given: Problem, healthy: Fitted) -> list[Candidate]:
    """A candidate for each property that was measured apart."""
    wrong = (e.wrong for e in catalogue().values() if e.wrong is not None)
    return [c for candidates in wrong for c in candidates(given, healthy.jacobian)]


def together(
    given: Problem,
    gap: Gap,
    healthy: Fitted,
    joint: Fitted,
    left: Sequence[Scatter] = (),
    redrawn: Sequence[Problem] = (),
) -> Gap:
    """Add the effects of a joint fit as candidates, linearised where they act together.

    The shift of each is the change from leaving it out; what they do only together is divided evenly. Random
    effects take their size in what the joint fit leaves (`left`).
    """
    anew = {s.effect: _scattering(s, gap.rows) for s in left}
    gap = replace(gap, candidates=tuple(anew.get(c.name, c) for c in gap.candidates))
    if len(joint.effects) < 2:
        return gap

    def of(problem: Problem, healthy: Fitted, joint: Fitted) -> Gap:
        return replace(gap, candidates=(*gap.candidates, *_joint(problem, healthy, joint)))

    more = of(given, healthy, joint)
    if gap.carried is None:
        return more
    kept = gap.carried.shape[2]

    def on(other: Problem) -> np.ndarray:
        return of(other, on_other(other, healthy), on_other(other, joint)).raw_columns[:, kept:]

    noise = _spectra(gap.rows, carried(more.raw_columns[:, kept:], redrawn, on))
    return replace(more, carried=np.concatenate([gap.carried, noise], 2))


def _joint(given: Problem, healthy: Fitted, joint: Fitted) -> list[Candidate]:
    """The effects of a joint fit as separate candidates."""
    k = given.num_common
    # The shift by all of them.
    all_of_them = healthy.residual - joint.residual - healthy.jacobian @ (healthy.u[:k] - joint.u[:k])
    alone, others = [], [tuple(e for e in joint.effects if e != key) for key in joint.effects]
    for key, rest in zip(joint.effects, others, strict=True):
        u = joint.u.copy()
        own = columns_of(given, (key,))[k:]
        u[own] = 0.0
        alone.append(residual_at(given, rest, u)[given.there] - joint.residual)
    both, doubts = (all_of_them - sum(alone)) / len(alone), (joint.doubts - healthy.doubts) / len(alone)
    out, at = [], k
    for key, rest, shift in zip(joint.effects, others, alone, strict=True):
        free = free_of(key)
        out.append(_candidate(given, key, joint.columns[at : at + len(free)], joint.u, shift + both,
                              joint.jacobian[:, at : at + len(free)], doubts, rest))  # fmt: skip
        at += len(free)
    return out


def _turning(given: Problem, angle: float) -> np.ndarray:
    """Additional variance (n,) of cosine coefficients if standing blocks turn in the grip by up to an angle
    [rad].

    It shows in the distance and offset of the fingers, and in their height except for its mean, at which the
    block stands.
    """
    rows, there, arrays = rows_of(given), given.there, given.frame.arrays
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    size = given.weight * (angle * width)[..., None]
    stands = arrays.phase[..., [Phase.PICKUP, Phase.PLACE]].sum(-1) > 0
    stands = np.repeat(stands[..., None], len(CHANNELS), -1)[there]
    mean = np.zeros(stands.size, bool)
    mean[np.unique(rows.cell, return_index=True)[1]] = True
    y, distance, offset = (rows.channel == CHANNELS.index(c) for c in ("y", "distance", "offset"))
    return np.square(size[there]) * (stands & (distance | offset | (y & ~mean)))


def _at_nominal(f: Fitted, healthy: Fitted) -> np.ndarray:
    """The residual (n,) of a fit with properties at their nominal values, to first order."""
    return f.residual - healthy.jacobian @ f.u[: healthy.columns.size]


def _shifting(given: Problem, f: Fitted, healthy: Fitted) -> Candidate:
    """A fit of one effect as a candidate: its shift with properties at their nominal values."""
    k, shift = given.num_common, _at_nominal(healthy, healthy) - _at_nominal(f, healthy)
    doubts = f.doubts - healthy.doubts
    return _candidate(given, f.effects[0], f.columns[k:], f.u, shift, f.jacobian[:, k:], doubts)


def _candidate(
    given: Problem,
    key: str,
    own: np.ndarray,
    u: np.ndarray,
    shift: np.ndarray,
    jacobian: np.ndarray,
    doubts: float,
    beside: Sequence[str] = (),
) -> Candidate:
    """One form of an effect as a candidate, linearised at coordinates u `beside` effects of other keys.

    `own` are its columns among the coordinates.
    """
    free, effect = free_of(key), catalogue()[name_of(key)]
    low, high = slots(given.num_common)[1][:, own]
    turned = sum(float(p.value(u[c])) for p, c in zip(free, own, strict=True) if p.name == effect.turns)
    return Candidate(
        effect.name, tuple(p.name for p in free), u[own], np.zeros(own.size), np.ones(own.size), shift,
        -jacobian,
        low, high, evidence=-doubts,
        form=RESPONSE if effect.exact else MODELLED,
        hidden=tuple(p.name for p in free if p.hidden or p.shape),
        size=np.array([1 / p.sd if p.log else np.nan for p in free]),
        frees=_turning(given, turned) if effect.turns else None,
        beside=tuple(name_of(k) for k in beside),
    )  # fmt: skip


def _scattering(s: Scatter, rows: Rows) -> Candidate:
    """A random effect as a candidate, its variance relative to the noise of these rows.

    If its size is not the same everywhere it is an imitation and cannot be the cause.
    """
    nothing, count = np.zeros(0), s.variance.size
    variance = s.variance / (1.0 if rows.sd is None else np.square(rows.sd))
    return Candidate(s.effect, (), nothing, nothing, nothing, np.zeros(count), np.zeros((count, 0)), nothing,
                     nothing, variance, s.known if s.same else -np.inf, frees=s.frees)  # fmt: skip


# Forces rounded to a step: the variance of every residual that they enter.
#
# A rounded reading is off by up to half a step, with variance step^2 / 12. While it stays on one level the
# error is constant or, as a force passes slowly through the level, changes evenly from one half step to the
# other: errors within a plateau are alike, or practically independent (Widrow & Kollar, Quantization Noise,
# 2008, ch. 1 on slow signals). Here both are equally likely. Through the pads' compliance errors of forces
# are errors of distances as well.

TOGETHER = 0.5  # prior: share of the error that is constant within a plateau


def rounded_variance(given: Problem, step: float) -> np.ndarray:
    """Variance (n,) of the cosine coefficients of each cell from forces rounded to `step` [N], over the
    noise's.

    Coefficients are in the order of `rows_of`.
    """
    frame, there = given.frame, given.there
    rows, sample, scale = rows_of(given), np.nonzero(there)[1], given.weight[there]
    shares, out = _shares(given), np.zeros(scale.size)
    # Number of the plateau of each reading.
    levels = [np.cumsum(np.diff(f, axis=0, prepend=f[:1]) != 0, axis=0) for f in frame.forces]
    for mine in rows.by_cell():
        trial, of_channel = rows.trial[mine[0]], shares[:, rows.channel[mine[0]]]
        group = frame.groups[trial]
        for k in np.flatnonzero(of_channel):
            weight = of_channel[k] * scale[mine]
            on = weight[:, None] * _on_plateaus(levels[trial][:, k], sample[mine], group)
            alike = np.square(np.asarray(dct(on, axis=0, norm="ortho"))).sum(1)
            out[mine] += TOGETHER * alike + (1 - TOGETHER) * np.mean(weight**2) / group
    return step**2 / 12 * out


def _shares(given: Problem) -> np.ndarray:
    """Coefficients (4, C) of each force's error in every channel: net forces, and the pads' compression."""
    world, out = given.frame.world, np.zeros((4, len(CHANNELS)))
    for axis, give, place, apart, net, half in (
        (0, world.give_normal, "x", "distance", "fx", "grip"),
        (1, world.give_shear, "y", "offset", "fy", "shear"),
    ):
        for finger in (0, 1):
            for channel, share in (
                (place, give[finger] / 2), (apart, give[finger]), (net, 1.0), (half, 0.5)
            ):  # fmt: skip
                out[2 * finger + axis, CHANNELS.index(channel)] = share
    return out


def _on_plateaus(level: np.ndarray, sample: np.ndarray, group: int) -> np.ndarray:
    """Share (m, R) of the readings averaged into each of m samples that is on each of R plateaus."""
    mine = level[sample[:, None] * group + np.arange(group)]
    number = mine - mine.min()
    out = np.zeros((sample.size, int(number.max()) + 1))
    np.add.at(out, (np.arange(sample.size)[:, None], number), 1 / group)
    return out[:, out.any(0)]
