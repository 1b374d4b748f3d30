"""The gap of aligned trials as an attribution takes it: whitened rows, nuisances, linearised candidates."""

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
    cost_at,
    evaluated,
    free_of,
    limits,
    neutral,
    residual_at,
    tolerated,
)
from simgap.gap.sensor_noise import MEDIAN
from simgap.phases import Phase

# What scatters residuals instead of shifting them: the variance that an effect adds, and how much of it.


@dataclass(frozen=True)
class Scatter:
    """`variance` (n,) over the noise's that an effect of size `value` adds to each cosine coefficient of a
    cell (in the order of `assemble.rows_of`), log sd of that value, and evidence [nats] `known` of another
    kind. `same`: whether its size is the same everywhere. The variance of
    coefficients that it `frees` may be larger by so much (n,), whatever it is."""

    effect: str
    value: float
    log_sd: float
    variance: np.ndarray
    known: float = 0.0
    same: bool = True
    frees: np.ndarray | None = None


def on_grid(
    effect: str, square: np.ndarray, unit: np.ndarray, grid: np.ndarray, part: np.ndarray | None = None,
    spread: float = 0.0,
) -> Scatter:  # fmt: skip
    """The most likely size of a scatter with variance size^2 `unit` (n,), from squares (n,) of residuals.

    `part` (n,): numbers of parts in which one cause has one size, but for a log sd of `spread`. One that
    would have any other in each, by a Bayes factor of POSITIVE, or a size at the grid's end, is an imitation.
    """
    mine = np.flatnonzero(unit > 0)
    variance = 1 + grid[:, None] ** 2 * unit[mine]
    nats = 0.5 * (square[mine] * (1 - 1 / variance) - np.log(variance))
    score = nats.sum(1)
    best, weight = int(score.argmax()), np.exp(score - score.max())
    centre = np.average(np.log(grid), weights=weight)
    sd = max(float(np.sqrt(np.average((np.log(grid) - centre) ** 2, weights=weight))), 1e-3)
    known = float(np.log(np.mean(weight)))  # what the choice of its size costs: uniform over the grid
    same = best < grid.size - 1
    if part is not None:
        each = np.stack([np.bincount(part[mine], row) for row in nats])
        several = (np.logaddexp.reduce(each, axis=0) - np.log(grid.size)).sum()
        if spread > 0:
            near = norm.logpdf(np.log(grid), np.log(grid)[:, None], spread)
            near -= np.logaddexp.reduce(near, axis=1, keepdims=True)
            each = np.logaddexp.reduce(near[:, :, None] + each, axis=1)
        one = np.logaddexp.reduce(each.sum(1)) - np.log(grid.size)
        same = same and bool(one > several - POSITIVE)
    return Scatter(effect, float(grid[best]), sd, grid[best] ** 2 * unit, known, same)


def scatters(given: Problem, residual: np.ndarray, names: list[str]) -> list[Scatter]:
    """What each of the named effects that scatter adds to residuals (n,); not those that say nothing."""
    scattering: list[Callable] = [
        e.scatter for n, e in catalogue().items() if n in names and e.scatter is not None
    ]
    found = [scatter(given, residual) for scatter in scattering]
    return [s for s in found if s is not None]


# How loud a recording's noise is and how it is coloured, learned where nothing but noise is expected.
#
# A velocity's residual averages three samples of velocity and differences three of position, so its noise is
# not white: at low frequency it holds (4 + 2 cos w)^2 / 36 of the velocity's density and sin(w)^2 of the
# position's. Beyond that sensors of one kind may be louder than stated and remember their last error (AR(1)).
# Level and colour of each kind are the likeliest for the median squares of some frequency bands: free motion
# for forces, hands at rest for velocities, grips for positions. Medians do not see what an effect does in
# places.

KINDS = (("x", "y", "distance", "offset"), ("vx", "vy"), ("fx", "fy", "grip", "shear"))
LEVELS = np.linspace(0.6, 1.5, 37)  # prior: noise over the stated one; beyond that it is an effect
COLOURS = np.linspace(0.0, 0.4, 9)  # prior: correlation from sample to sample; more is an effect
NOISE_BANDS = 6  # numerics: of which medians are taken
SLOWEST = 1.0  # chosen: Hz; what is slower says more of effects than of noise
OUTLIER = 8.0  # chosen: nats that a band costs at most: an effect may fill it
FEWEST = 12  # numerics: coefficients of a band
CLEAN = 1.25  # numerics: variance of residuals over that of noise alone, beyond which they say nothing of it


def with_noise(given: Problem, rows: Rows, residual: np.ndarray) -> Rows:
    """The rows with the noise's standard deviation in each cosine coefficient of their cells, in units of the
    stated noise, and with the shape of white noise there."""
    turn, frequency = _places(rows)
    shape = _shape(given, rows, turn)
    square = cosines(rows, residual[:, None])[0][:, 0] ** 2 / shape
    arrays = given.frame.arrays
    there = given.whitening.weight > 0
    doubt = np.square(arrays.sd[there] / arrays.plain[there])
    sure = (np.bincount(rows.cell, doubt) < CLEAN * np.bincount(rows.cell))[rows.cell]
    phase = arrays.phase.argmax(-1)[..., None].repeat(len(CHANNELS), -1)[there]
    still = np.isin(phase, (Phase.PICKUP, Phase.PLACE))
    variance = shape.copy()
    # Hands that move do more within a sample than differences show: speeds have another noise there.
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
    """Of each coefficient (n,): radians from sample to sample, and frequency [Hz]."""
    turn, frequency = np.zeros(rows.cell.size), np.zeros(rows.cell.size)
    order = np.argsort(rows.cell, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(rows.cell[order])) + 1):
        turn[mine] = np.pi * np.arange(mine.size) / mine.size
        if mine.size > 1:
            frequency[mine] = turn[mine] / (2 * np.pi * np.median(np.diff(rows.time[mine])))
    return turn, frequency


def _shape(given: Problem, rows: Rows, turn: np.ndarray) -> np.ndarray:
    """Density (n,) of the residual's stated noise over white noise's of the same variance."""
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
    """Level and colour of coefficients at `turn` with these squares."""
    at = np.minimum((turn / np.pi * NOISE_BANDS).astype(int), NOISE_BANDS - 1)
    score = -0.5 * np.square(2 * np.log(LEVELS)[:, None] / STATED) + np.zeros(COLOURS.size)
    for band in range(NOISE_BANDS):
        mine = at == band
        if mine.sum() < FEWEST:
            continue
        seen = np.log(max(float(np.median(square[mine])) / MEDIAN, 1e-9))
        expected = 2 * np.log(LEVELS)[:, None] + np.log(_density(float(np.mean(turn[mine])), COLOURS))
        # The median of n squares is off by 2.33 / sqrt(n) of itself.
        score = score - np.minimum(0.5 * np.square(seen - expected) * mine.sum() / 2.33**2, OUTLIER)
    level, colour = np.unravel_index(int(score.argmax()), score.shape)
    return float(LEVELS[level]), float(COLOURS[colour])


# What sensors' noise makes of fitted candidates: the same ones on recordings with a little more noise.
#
# `simgap.attribution.posterior` takes it off the products of their columns.

Other = TypeVar("Other")

# numerics: signs of draws by places; products of what has different places cancel over the draws
SIGNS = np.array([[1, 1], [1, -1]], float)
SIZES = (1.0, -0.25)  # numerics: sds of noise of a draw; both show whether it acts in proportion
ALIKE = 0.5  # numerics: by which share of the larger both may differ


def redrawn(given: Problem) -> tuple[Problem, ...]:
    """The problem with more noise on what was recorded: of every draw one of each of SIZES.

    Every number is off by its sensor's standard deviation, up or down. Signs of a sample and the next, and
    of a channel and the next, are orthogonal over the draws, so that squares of what combines these have
    their expectation without any scatter.
    """
    world, sensor = given.frame.world, given.frame.arrays.sensor
    place = (np.arange(world.t.shape[1])[:, None] + np.arange(4)) % len(SIGNS)
    rng = np.random.default_rng(0)
    noise = {
        name: sensor[..., [k]] * rng.choice((-1.0, 1.0), (*world.t.shape, 4))
        for k, name in enumerate(("joints", "rates", "force"))
    }
    out = []
    for signs in SIGNS.T:
        for size in SIZES:
            shaken = {n: getattr(world, n) + size * signs[place] * each for n, each in noise.items()}
            frame = replace(given.frame, world=world._replace(**shaken))
            out.append(with_nuisances(replace(given, frame=frame)))
    return tuple(out)


def carried(columns: np.ndarray, others: Sequence[Other], on: Callable[[Other], np.ndarray]) -> np.ndarray:
    """What noise makes of columns (n, M), (D, n, M) draws, from those `on` the redrawn recordings.

    Where it does not act in proportion, as next to a contact that it makes or breaks, it is undetermined.
    """
    changes = [(on(other) - columns) / size for other, size in zip(others, SIZES * len(SIGNS.T), strict=True)]
    out = []
    for one, other in zip(changes[::2], changes[1::2], strict=True):
        alike = np.abs(one - other) <= ALIKE * np.maximum(np.abs(one), np.abs(other))
        out.append(np.where(alike, (one + other) / 2, 0.0).astype(np.float32))
    return np.stack(out)


def on_other(other: Problem, f: Fitted, usual: np.ndarray | None = None) -> Fitted:
    """A fit's residual and derivatives at the same coordinates on another recording; `usual`: those by the
    properties, where they are known."""
    at = cost_at(other, f.effects, f.u, f.columns, [])
    now = evaluated(other, f.effects, f.u, f.columns, at, usual)
    return replace(f, residual=now.residual, push=now.push)


def noise_gained(others: Sequence[Problem], healthy: Fitted, f: Fitted) -> float:
    """What a fit gains [nats] over the one without effects by leaving less of the sensors' noise."""
    columns = np.stack([healthy.residual, f.residual], 1)
    noise = carried(
        columns,
        others,
        lambda other: np.stack([on_other(other, healthy).residual, on_other(other, f).residual], 1),
    )
    without, left = np.square(noise.astype(float)).sum(1).mean(0)
    return 0.5 * float(without - left)


SHOWN = 1.0  # chosen: squared residual [noise's] of a property as wrong as usual, above which it shows at all


def rows_of(given: Problem) -> Rows:
    """What each residual is, cells in the order of time."""
    frame, there = given.frame, given.whitening.weight > 0
    trial, sample, channel = np.nonzero(there)
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
    """The gap with a candidate for every fit (of one effect each) and scatter, and for properties that were
    measured apart. What sensors' noise makes of them is seen on `redrawn` recordings."""
    rows = with_noise(given, rows_of(given), given.nuisances.left(healthy.residual))
    usual = given.frame.rig.tolerance == Tolerance()
    scattering, tolerance = [_scattering(s, rows) for s in scatters], tolerated(given)
    # Which properties show is decided here alone: with more noise on the recordings others might.
    measured = _measured(given, healthy)
    seen = {c.parameters for c in measured if np.square(c.jacobian * c.scale).sum() > SHOWN}

    def at(problem: Problem, healthy: Fitted, fits: Sequence[Fitted]) -> Gap:
        k = problem.num_properties
        start = healthy.residual - healthy.push @ healthy.u[:k]
        nuisance = np.concatenate([-healthy.push, problem.nuisances.columns], 1)
        shifting = [_shifting(problem, f, start, healthy.push, healthy.doubts) for f in fits]
        measured = [c for c in _measured(problem, healthy) if c.parameters in seen]
        every = (*shifting, *scattering, *measured)
        return Gap(rows, start, nuisance, every, tolerance=tolerance, usual=usual)

    gap = at(given, healthy, fits)
    if not redrawn:
        return gap

    def on(other: Problem) -> np.ndarray:
        plain = on_other(other, healthy)
        return at(other, plain, [on_other(other, f, plain.push) for f in fits]).raw_columns

    return replace(gap, carried=carried(gap.raw_columns, redrawn, on))


def _measured(given: Problem, healthy: Fitted) -> list[Candidate]:
    """A candidate for each property that was measured apart."""
    wrong = [e.wrong for e in catalogue().values() if e.wrong is not None]
    return [c for candidates in wrong for c in candidates(given, healthy.push)]


def together(
    given: Problem,
    gap: Gap,
    healthy: Fitted,
    joint: Fitted,
    left: Sequence[Scatter] = (),
    redrawn: Sequence[Problem] = (),
) -> Gap:
    """The gap with further candidates: the effects of a joint fit, linearised where they are together.

    Each shifts the residual by what leaving it out changes; what they do only together is parted evenly.
    What scatters is as large as it is in what they leave (`left`).
    """
    anew = {s.effect: _scattering(s, gap.rows) for s in left}
    gap = replace(gap, candidates=tuple(anew.get(c.name, c) for c in gap.candidates))
    if len(joint.effects) < 2:
        return gap

    def of(problem: Problem, healthy: Fitted, joint: Fitted) -> Gap:
        return replace(gap, candidates=(*gap.candidates, *_joint(problem, healthy, joint)))

    return _carrying(gap, of(given, healthy, joint), redrawn,
                     lambda other: of(other, on_other(other, healthy), on_other(other, joint)))  # fmt: skip


def _joint(given: Problem, healthy: Fitted, joint: Fitted) -> list[Candidate]:
    """The effects of a joint fit as candidates of their own."""
    k, there = given.num_properties, given.whitening.weight > 0
    # What all of them take off.
    all_of_them = healthy.residual - joint.residual - healthy.push @ (healthy.u[:k] - joint.u[:k])
    alone = []
    for key in joint.effects:
        u = joint.u.copy()
        own = columns_of(given, (key,))[k:]
        u[own] = neutral(given)[own]
        rest = tuple(e for e in joint.effects if e != key)
        alone.append(residual_at(given, rest, u)[there] - joint.residual)
    both, doubts = (all_of_them - sum(alone)) / len(alone), (joint.doubts - healthy.doubts) / len(alone)
    out, at = [], k
    for key, shift in zip(joint.effects, alone, strict=True):
        free = free_of(key)
        out.append(_candidate(given, key, joint.columns[at : at + len(free)], joint.u, shift + both,
                              joint.push[:, at : at + len(free)], doubts))  # fmt: skip
        at += len(free)
    return out


def after(
    given: Problem, gap: Gap, healthy: Fitted, first: Fitted, joint: Sequence[Fitted],
    redrawn: Sequence[Problem],
) -> Gap:  # fmt: skip
    """The gap with further candidates: the last effects of joint fits, linearised after the `first` one.

    Each shifts the residual by what its fit takes off beyond what the first does there.
    """

    def of(problem: Problem, healthy: Fitted, first: Fitted, joint: Sequence[Fitted]) -> Gap:
        k, own = problem.num_properties, []
        start = healthy.residual - healthy.push @ healthy.u[:k]
        one = _shifting(problem, first, start, healthy.push, healthy.doubts)
        for f in joint:
            both = start - (f.residual - healthy.push @ f.u[:k])
            known = one.shift + one.jacobian @ (f.u[first.columns[k:]] - one.at)
            mine = slice(first.columns.size, None)
            own.append(_candidate(problem, f.effects[-1], f.columns[mine], f.u, both - known,
                                  f.push[:, mine], f.doubts - first.doubts))  # fmt: skip
        return replace(gap, candidates=(*gap.candidates, *own))

    def on(other: Problem) -> Gap:
        plain = on_other(other, healthy)
        one, *others = (on_other(other, f, plain.push) for f in (first, *joint))
        return of(other, plain, one, others)

    return _carrying(gap, of(given, healthy, first, joint), redrawn, on)


def _carrying(gap: Gap, more: Gap, redrawn: Sequence[Problem], on: Callable[[Problem], Gap]) -> Gap:
    """A gap with `more` candidates, and with what sensors' noise makes of these."""
    if gap.carried is None:
        return more
    kept = gap.carried.shape[2]
    noise = carried(more.raw_columns[:, kept:], redrawn, lambda other: on(other).raw_columns[:, kept:])
    return replace(more, carried=np.concatenate([gap.carried, noise], 2))


def _turning(given: Problem, angle: float) -> np.ndarray:
    """Variance (n,) of cosine coefficients where standing blocks turn in the grip by up to an angle [rad].

    It shows in the fingers' distance and offset, and in their height, but not in its mean: there the block
    stands.
    """
    rows, weight, arrays = rows_of(given), given.whitening.weight, given.frame.arrays
    width = np.einsum("tnm,mo,o->tn", arrays.onehot, arrays.objects, given.centre[:, 1])
    size, there = weight * (angle * width)[..., None], weight > 0
    stands = arrays.phase[..., [Phase.PICKUP, Phase.PLACE]].sum(-1) > 0
    stands = np.repeat(stands[..., None], len(CHANNELS), -1)[there]
    mean = np.zeros(stands.size, bool)
    mean[np.unique(rows.cell, return_index=True)[1]] = True
    y, distance, offset = (rows.channel == CHANNELS.index(c) for c in ("y", "distance", "offset"))
    return np.square(size[there]) * (stands & (distance | offset | (y & ~mean)))


def _shifting(given: Problem, f: Fitted, start: np.ndarray, push: np.ndarray, usual: float) -> Candidate:
    """A fit as a candidate: what it takes off the residual, at properties' own nominal; `usual` [nats]: the
    doubts without it."""
    k = given.num_properties
    shift = start - (f.residual - push @ f.u[:k])
    return _candidate(given, f.effects[0], f.columns[k:], f.u, shift, f.push[:, k:], f.doubts - usual)


def _candidate(
    given: Problem,
    key: str,
    own: np.ndarray,
    u: np.ndarray,
    shift: np.ndarray,
    push: np.ndarray,
    doubts: float,
) -> Candidate:
    """One form of an effect at coordinates u, of which it has the columns `own`."""
    free, effect = free_of(key), catalogue()[name_of(key)]
    low, high = (edge[own] for edge in limits(given))
    turned = sum(float(p.value(u[c])) for p, c in zip(free, own, strict=True) if p.name == effect.turns)
    return Candidate(
        effect.name, tuple(p.name for p in free), u[own], neutral(given)[own], np.ones(own.size), shift,
        -push,
        low, high, evidence=-doubts,
        form=RESPONSE if effect.exact else MODELLED,
        hidden=tuple(p.name for p in free if p.hidden or p.shape),
        size=np.array([1 / p.sd if p.log else np.nan for p in free]),
        frees=_turning(given, turned) if effect.turns else None,
    )  # fmt: skip


def _scattering(s: Scatter, rows: Rows) -> Candidate:
    """What scatters as a candidate; its variance over that of the noise as it is in these rows.

    One whose size is not the same everywhere is an imitation, which nothing speaks for.
    """
    nothing, count = np.zeros(0), s.variance.size
    variance = s.variance / (1.0 if rows.sd is None else np.square(rows.sd))
    return Candidate(s.effect, (), nothing, nothing, nothing, np.zeros(count), np.zeros((count, 0)), nothing,
                     nothing, variance, s.known if s.same else -np.inf, frees=s.frees)  # fmt: skip


# Forces rounded to a step: by how much every residual that they enter is in doubt.
#
# A rounded reading is off by up to half a step, with a variance of step^2 / 12. While it stays on one level
# it is off by the same, or, as a force passes slowly through the level, by what changes evenly from one half
# to the other: errors within a plateau are alike or as good as independent (Widrow & Kollar, Quantization
# Noise, 2008, ch. 1 on slow signals). One is as likely here as the other. Through the pads that give,
# forces' errors are those of distances as well.

TOGETHER = 0.5  # prior: share of a plateau's errors that are alike throughout it


def rounded_variance(given: Problem, step: float) -> np.ndarray:
    """Variance (n,) of the cosine coefficients of each cell, in the noise's, of forces rounded to `step` [N].

    Coefficients are in the order of `assemble.rows_of`.
    """
    frame, there = given.frame, given.whitening.weight > 0
    rows, sample, scale = rows_of(given), np.nonzero(there)[1], given.whitening.weight[there]
    shares, out = _shares(given), np.zeros(scale.size)
    levels = [_plateaus(force) for force in frame.forces]
    order = np.argsort(rows.cell, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(rows.cell[order])) + 1):
        trial, of_channel = rows.trial[mine[0]], shares[:, rows.channel[mine[0]]]
        group = frame.groups[trial]
        for k in np.flatnonzero(of_channel):
            weight = of_channel[k] * scale[mine]
            on = weight[:, None] * _on_plateaus(levels[trial][:, k], sample[mine], group)
            alike = np.square(np.asarray(dct(on, axis=0, norm="ortho"))).sum(1)
            out[mine] += TOGETHER * alike + (1 - TOGETHER) * np.mean(weight**2) / group
    return step**2 / 12 * out


def _shares(given: Problem) -> np.ndarray:
    """How much (4, C) of each force's error every channel has: net forces, and what pads give."""
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


def _plateaus(force: np.ndarray) -> np.ndarray:
    """The number (N, 4) of the plateau that each reading is on."""
    return np.cumsum(np.diff(force, axis=0, prepend=force[:1]) != 0, axis=0)


def _on_plateaus(level: np.ndarray, sample: np.ndarray, group: int) -> np.ndarray:
    """Share (m, R) of the readings behind each of m samples that is on each of R plateaus."""
    mine = level[sample[:, None] * group + np.arange(group)]
    number = mine - mine.min()
    out = np.zeros((sample.size, int(number.max()) + 1))
    np.add.at(out, (np.arange(sample.size)[:, None], number), 1 / group)
    return out[:, out.any(0)]
