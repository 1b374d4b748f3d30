"""The linear-Gaussian core of the properties' likelihood, assembled from aligned trials.

Every grip of every trial gives up to three observations (`estimation.observations`), each in its channel c:

    mean = A . unknowns + J . deviations + unit (common_c + own) + noise.

A contains gravity factors (force), ones (distance) and coefficients of heights (rise); J finite differences
through the hand: for each deviation in the rig's [systematic] table the trial is re-read by a hand that
deviates by a small step, with the same sample weights. `unit` is the quantity on which the channel's equation
rests: the carried force, the pads' give along the grip, the difference of their shear deflection between
pickup and place. Model error is a share of it: one share common to all grips, and one that differs between
grips. Slopes over the pads' give within a grip (`estimation.pads`) show these shares directly (unit 1),
whatever the block.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product
from math import gcd, lcm

import numpy as np

from estimation import observations, pads
from estimation.observations import Noise, WeighedTrial
from estimation.pads import SLOPE_SD, UNSTATED
from hmmseg.contact.decompose import FREE, PROPERTIES, height_equations, reduced
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.levels import SURE
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from hmmseg.segmentation.emissions import thin

Terms = dict[str, int]


def simplest_combinations(rows: Iterable[Mapping[str, int]], order: Sequence[str]) -> list[Terms]:
    """Independent coprime combinations of the unknowns in `order` that span `rows`, single ones first."""
    given = [_whole({k: Fraction(v) for k, v in r.items() if v}, order) for r in rows if any(r.values())]
    echelon = [_whole(row, order) for row in _echelon(given, order)]
    single = [row for row in echelon if len(row) == 1]
    known = {name for row in single for name in row}
    rest = [{k: Fraction(v) for k, v in row.items() if k not in known} for row in given]
    left = [_whole(row, order) for row in rest if row] + [r for r in echelon if len(r) > 1]
    chosen = list(single)
    for row in sorted(left, key=lambda r: (len(r), min(r.values()) < 0, sum(map(abs, r.values())))):
        if len(_echelon([*chosen, row], order)) > len(chosen):
            chosen.append(row)
    return sorted(single, key=lambda row: order.index(next(iter(row)))) + chosen[len(single) :]


def _echelon(rows: Iterable[Mapping[str, int]], order: Sequence[str]) -> list[dict[str, Fraction]]:
    """Rows of the reduced row echelon form, pivots in `order`."""
    exact = [{k: Fraction(v) for k, v in row.items()} for row in rows]
    return list(reduced(exact, lambda row: next((name for name in order if name in row), None)).values())


def _whole(row: Mapping[str, Fraction], order: Sequence[str]) -> Terms:
    """The same direction with coprime integer coefficients, the first positive."""
    terms = {name: row[name] for name in order if name in row}
    common = lcm(*(v.denominator for v in terms.values()))
    whole = {k: int(v * common) for k, v in terms.items()}
    share = gcd(*whole.values())
    sign = 1 if next(iter(whole.values())) > 0 else -1
    return {k: sign * v // share for k, v in whole.items()}


FORCE, DISTANCE, RISE = range(len(observations.CHANNELS))


@dataclass(frozen=True)
class Unknown:
    """A quantity that the recording determines: a property, or a combination of one property over objects."""

    prop: str
    terms: Terms

    @property
    def single(self) -> bool:
        """Whether it is a property of one object."""
        return len(self.terms) == 1

    @property
    def properties(self) -> tuple[str, ...]:
        """`object.property` of all terms."""
        return tuple(f"{obj}.{self.prop}" for obj in self.terms)

    @property
    def name(self) -> tuple[str, str]:
        """(object, property); the objects of a combination joined as in `b + c`."""
        text = ""
        for obj, c in self.terms.items():
            sign = " - " if c < 0 else " + "
            text += (sign if text else "") + (obj if abs(c) == 1 else f"{abs(c)} {obj}")
        return text, self.prop


def determined(
    task: BlockTask, objects: Sequence[str], rises: dict[int, Terms], there: np.ndarray
) -> tuple[Unknown, ...]:
    """Unknowns determined by the moves recorded in `there` (num_moves, 3), objects in the task's order."""
    weighed, spanned = (set(np.array(objects)[there[:, c]]) for c in (FORCE, DISTANCE))
    heights = simplest_combinations([rises[int(m)] for m in np.flatnonzero(there[:, RISE])], task.objects)
    out = []
    for name in task.objects:
        shown = {"weight": name in weighed, "width": name in spanned, "height": {name: 1} in heights}
        out += [Unknown(prop, {name: 1}) for prop, seen in shown.items() if seen]
    return (*out, *(Unknown("height", terms) for terms in heights if len(terms) > 1))


def coefficients_of(
    unknowns: Sequence[Unknown], objects: Sequence[str], rises: dict[int, Terms]
) -> np.ndarray:
    """Coefficients (num_moves, 3, Q) of the unknowns in each observation of a move."""
    out = np.zeros((len(objects), len(observations.CHANNELS), len(unknowns)))
    heights = [i for i, u in enumerate(unknowns) if u.prop == "height"]
    names = list(dict.fromkeys(name for i in heights for name in unknowns[i].terms))
    basis = np.array([[unknowns[i].terms.get(name, 0) for name in names] for i in heights], float)
    for m, obj in enumerate(objects):
        for i, u in enumerate(unknowns):
            if u.single and obj in u.terms and u.prop != "height":
                out[m, PROPERTIES.index(u.prop), i] = 1.0
        if heights and rises[m] and set(rises[m]) <= set(names):
            rise = np.array([rises[m].get(name, 0) for name in names], float)
            solved, *_ = np.linalg.lstsq(basis.T, rise, rcond=None)
            if np.abs(solved @ basis - rise).max() < 1e-9:
                out[m, RISE, heights] = np.where(np.abs(solved) > 1e-9, solved, 0.0)
    return out


# prior: largest sd of a pad's exponent about 1. A pad of doubtful stiffness need not be linear: at half the
# force its compliance may be off by as much again. Elastic contact (Hertz) has 2/3, most pads 2/3 to 1.
MOST_BENT = 0.5
UNLIKE = 0.3  # prior: difference between both pads, as a share of their common deviation: foams of one make


Read = Callable[[Trial, Rig, float], Signals]  # signals of a trial by a hand that deviates by a size


@dataclass(frozen=True)
class Nuisance:
    """One deviation of the hand."""

    name: str
    sd: float  # prior
    step: float  # a small deviation for finite differences
    read: Read


def _with_channel(name: str, change: Callable[[np.ndarray, float], np.ndarray]) -> Read:
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        channels = trial.channels | {name: change(trial.channels[name], size)}
        return task_space(replace(trial, channels=channels), rig)

    return read


def _longer_link(finger: int, link: int) -> Read:
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        fingers, nominal = dict(rig.fingers or {}), rig.finger(finger)
        links = list(nominal.links)
        links[link] *= 1 + size
        fingers[str(finger)] = nominal.model_copy(update={"links": tuple(links)})
        return task_space(trial, rig.model_copy(update={"fingers": fingers}))

    return read


@dataclass(frozen=True)
class PadDoubt:
    """Disagreement of recordings with the rig about both pads, along the grip or in shear."""

    share: float = 0.0  # their compliance seems 1 + this times the nominal
    odds: float = 0.0  # probability that the rig is wrong by that
    apart: float = 0.0  # error common to all slopes
    give: float = 0.0  # possible give of pads of unstated stiffness, according to the recordings
    usual: float = 1.0  # [N] typical force of one finger in a grip, or where a block is put down
    seen: tuple[float, float] = (0.0, np.inf)  # the share and its sd whatever the odds

    @property
    def extra_sd(self) -> float:
        """Prior sd of the share beyond what the rig admits: 0 if it is right, the slopes' share if wrong."""
        return abs(self.share) * float(np.sqrt(self.odds))

    @property
    def slope_sd(self) -> float:
        """Common error of slopes, and of each: a share of the true give, and noise in forces or places."""
        return float(np.hypot(SLOPE_SD * (self.give or 1.0), self.apart))


def _other_pads(kind: str, fingers: tuple[int, ...], usual: float | None = None) -> Read:
    def read(trial: Trial, rig: Rig, size: float) -> Signals:
        """Pads of 1 + size times the nominal compliance; with `usual`, which give as force^(1 + size)."""
        signals, moved = task_space(trial, rig), {}
        for finger in fingers:
            name = f"{'x' if kind == 'normal' else 'y'}{finger}"
            law = getattr(signals, f"f{name}")
            if usual is not None:
                law = law * np.log(np.maximum(np.abs(law), 1e-3 * usual) / usual)
            compliance = getattr(pads.unit_pads(rig), f"{kind}{finger}")
            moved[name] = getattr(signals, name) - law * compliance * size
        return replace(signals, **moved)

    return read


def _wider(trial: Trial, rig: Rig, size: float) -> Signals:
    """Fingers that touch a block when they are `size` farther apart than their distance says."""
    signals = task_space(trial, rig)
    return replace(signals, x1=signals.x1 - size / 2, x2=signals.x2 + size / 2)


def nuisances(
    rig: Rig, biased: np.ndarray, doubts: Mapping[str, PadDoubt], touch_sd: float = 0.0
) -> tuple[Nuisance, ...]:
    """Deviations that the rig admits or recordings reveal: `biased` (4,), extra prior sd of each force bias
    [N], `doubts` about both pads, `touch_sd` [m] of the distance at which fingers touch a block."""
    s, out = rig.systematic, list[Nuisance]()

    def admit(name: str, sd: float, step: float, read: Callable[[Trial, Rig, float], Signals]) -> None:
        if sd > 0:
            out.append(Nuisance(name, float(sd), step, read))

    for name, bias, more, gain in zip(FORCE_CHANNELS, s.force_bias, biased, s.force_gain, strict=True):
        admit(f"force_bias.{name}", np.hypot(bias, more), 1e-3, _with_channel(name, lambda f, b: f - b))
        admit(f"force_gain.{name}", gain, 1e-3, _with_channel(name, lambda f, g: f / (1 + g)))
    if rig.jointed:
        for name, sd in zip(JOINTS, s.joint_offset, strict=True):
            admit(f"joint_offset.{name}", sd, 1e-5, _with_channel(name, lambda q, d: q - d))
        for (finger, link), sd in zip(product((1, 2), (0, 1)), s.link_length, strict=True):
            admit(f"link_length.{finger}{link + 1}", sd, 1e-5, _longer_link(finger, link))
    # Slopes show compliance and exponent together, so either may be off by as much as both.
    stated = min(max(doubts["normal"].extra_sd, *s.pad_stiffness) / np.log(2), MOST_BENT)
    # The pads of one hand are of one make, so most of the stated uncertainty of their stiffness is common.
    common = min(s.pad_stiffness) * np.sqrt(1 - UNLIKE**2)
    for kind, doubt in doubts.items():
        bend = MOST_BENT * doubt.give or (stated if kind == "normal" else 0.0)
        admitted = 0.0 if doubt.give else common
        both = max(doubt.extra_sd, UNSTATED if doubt.give else 0.0)
        both = float(np.hypot(np.hypot(both, bend) if both else 0.0, admitted))
        admit(f"pad_{kind}", both, 1e-3, _other_pads(kind, (1, 2)))
        for finger in (1, 2):
            own = 0.0 if doubt.give else s.pad_stiffness[finger - 1]
            sd = np.sqrt(own**2 - admitted**2 + (UNLIKE * max(doubt.extra_sd, doubt.give)) ** 2)
            admit(f"pad_{kind}.{finger}", sd, 1e-3, _other_pads(kind, (finger,)))
        if any(n.name.startswith(f"pad_{kind}") for n in out):
            admit(f"pad_{kind}_exponent", bend, 1e-3, _other_pads(kind, (1, 2), max(doubt.usual, 1e-3)))
    admit("touch", touch_sd, 1e-5, _wider)
    return tuple(out)


# Slopes that show the pads, by name in `WeighedTrial.slopes`: their channel, and the readings they weigh.
SLOPES = {"distance": (DISTANCE, "distance"), "rise": (RISE, "place"), "landing": (RISE, "place")}


def observe(signals: Signals, weighed: WeighedTrial, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Observed means (num_alignments, num_moves, 3) of one trial, NaN where nothing was recorded."""
    values, out = {k: np.nan_to_num(v) for k, v in observations.channel_values(signals, rig).items()}, []
    for move in moves:
        counts = weighed.counts[move]
        means = {k: np.where(counts[k] > 0, w @ values[k], np.nan) for k, w in weighed.grips[move].items()}
        out.append([means["force"], means["distance"], means["place"] - means["pickup"]])
    return np.moveaxis(np.array(out), 2, 0)


def observe_slopes(signals: Signals, weighed: WeighedTrial, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Slopes of readings over the pads' give (num_moves, len(SLOPES)) of one trial, NaN where absent."""
    values, out = observations.channel_values(signals, rig), np.full((len(moves), len(SLOPES)), np.nan)
    for i, move in enumerate(moves):
        for k, (name, (_, reading)) in enumerate(SLOPES.items()):
            slope = weighed.slopes.get(move, {}).get(name)
            if slope is not None:
                out[i, k] = slope.weights @ np.nan_to_num(values[reading])
    return out


def slope_variances(weighed: WeighedTrial, moves: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Variances (num_moves, len(SLOPES)) of slopes, infinite where absent, and their common errors."""
    slopes = [[weighed.slopes.get(m, {}).get(name) for name in SLOPES] for m in moves]
    variance = [[np.inf if s is None else s.variance for s in row] for row in slopes]
    return np.array(variance), np.array([[0.0 if s is None else s.alike for s in row] for row in slopes])


def pad_doubts(
    slopes: np.ndarray, variance: np.ndarray, alike: np.ndarray, weighed: Sequence[WeighedTrial], rig: Rig
) -> dict[str, PadDoubt]:
    """Evidence of slopes (num_trials, num_moves, len(SLOPES)), as of `slope_variances`, against the pads."""
    usual = []  # mean forces of one finger along the grip, and in shear where the block is put down
    for s, grip in ((a.signals, grip) for a in weighed for grip in a.grips.values()):
        along, up = np.nan_to_num(s.fx1 - s.fx2) / 2, np.nan_to_num(s.fy) / 2
        usual.append((np.mean(grip["distance"] @ along), abs(np.mean(grip["place"] @ up))))
    admitted, out = float(np.hypot(*rig.systematic.pad_stiffness)) / 2, {}
    # A width reads too small by the share of the give that the rig leaves out, a height too large.
    for (kind, channel, sign), force in zip(
        (("normal", DISTANCE, -1.0), ("shear", RISE, 1.0)), np.median(usual, axis=0).tolist(), strict=True
    ):
        stated = bool(np.isfinite(getattr(rig.fingertip, f"{kind}_stiffness")))
        own = np.isfinite(slopes) & (np.array([c for c, _ in SLOPES.values()]) == channel)
        shares, spread = sign * slopes[own], variance[own]
        apart = pads.shared_error(alike[own], spread)
        middle, error = pads.middle_share(shares, spread, 0.0) if shares.size else (0.0, np.inf)
        share, odds = pads.misstated(shares, spread, stated, admitted if stated else 0.0, apart)
        give = 0.0 if stated else pads.possible_share(shares, spread)
        out[kind] = PadDoubt(share, odds, apart, give, force, (middle, float(np.hypot(error, apart))))
    return out


def sampling_variance(weighed: WeighedTrial, noise: Noise, moves: Sequence[int]) -> np.ndarray:
    """Sampling variance (num_alignments, num_moves, 3) of the means, infinite where absent."""
    out = []
    with np.errstate(divide="ignore", invalid="ignore"):  # channels without readings
        for move in moves:
            part = {k: noise.variance[k] / n for k, n in weighed.counts[move].items()}
            rounded = weighed.rounding[1::2].sum() ** 2  # fingers that share a load are rounded alike
            out.append([part["force"] + rounded, part["distance"], part["pickup"] + part["place"]])
    return np.moveaxis(np.array(out), 2, 0)


def units(weighed: Sequence[WeighedTrial], raw: np.ndarray, rig: Rig) -> np.ndarray:
    """Units of the shares of model error (num_trials, num_moves, 3) [N, m, m]. That of a rise is at least the
    give under the weight, and the change of give in landing: what a pad does in between need not cancel where
    contact forces balance."""
    force = np.abs(raw[..., FORCE]).mean(axis=1)
    force = np.where(np.isfinite(force), force, np.nanmean(force) if np.isfinite(force).any() else 1.0)
    gives = []
    for a in weighed:
        squeeze, shear = (np.nan_to_num(of(a.signals, rig)) for of in (pads.squeeze_give, pads.shear_give))
        gives.append([(np.mean(w["distance"] @ squeeze), *(np.mean(w[k] @ shear) for k in
                      ("pickup", "force", "place"))) for w in a.grips.values()])  # fmt: skip
    grip, picked, carried, placed = np.moveaxis(np.array(gives), -1, 0)
    hanging = np.maximum(force, 1e-3) * (pads.unit_pads(rig).shear1 + pads.unit_pads(rig).shear2) / 4
    least = np.maximum(hanging, np.abs(placed - carried))
    rise = np.where(placed < picked, -1.0, 1.0) * np.maximum(np.abs(placed - picked), least)
    return np.stack([force, np.maximum(grip, 1e-7), rise], axis=-1)


def free_means(
    weighed: Sequence[WeighedTrial], noise: Noise, free_steps: Sequence[int], rig: Rig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean forces in free motion (num_trials, 4), their variances, and how far each zero moves (4,) [N]. A
    zero that moves between the free stretches of a trial (subtasks `free_steps`), beyond what noise and the
    rig's own bias allow, is known in a grip no better than these stretches agree."""
    mean = np.stack([observations.free_forces(a.signals, a) for a in weighed])
    count = np.array([max(a.free_count, 1.0) for a in weighed])
    of_sample = np.array([noise.variance[name] for name in FORCE_CHANNELS])
    variance = of_sample[None, :] / count[:, None] + np.array([a.rounding**2 for a in weighed])
    moved = np.stack([_moved_zero(a, free_steps, rig) for a in weighed])
    return mean, variance + moved**2, moved.max(axis=0)


def _zeros(a: WeighedTrial, free_steps: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean times (N,) of halves of free stretches of a trial, mean forces (N, 4) there, and their errors."""
    spans = [np.flatnonzero((a.masks[:, k].mean(axis=0) > 0.5) & (a.free > 0)) for k in free_steps]
    halves = [h for span in spans for h in np.array_split(span, 2) if h.size >= observations.MIN_FREE]
    if not halves:
        return np.zeros(1), np.zeros((1, 4)), np.ones((1, 4))
    each = [np.stack([getattr(a.signals, name)[half] for name in FORCE_CHANNELS]) for half in halves]
    noise = [[r.var() * observations.autocorrelation_time([r - r.mean()]) for r in four] for four in each]
    spread = np.median(noise, axis=0) + observations.LEAST**2
    errors = np.sqrt([spread / half.size + a.rounding**2 for half in halves])
    means = np.array([four.mean(axis=1) for four in each])
    return np.array([a.signals.t[half].mean() for half in halves]), means, errors


def zero_drift(a: WeighedTrial, free_steps: Sequence[int]) -> np.ndarray:
    """Steady drift (4,) of the forces' zeros within a trial [N/s], 0 where free motion shows no line."""
    t, means, errors = _zeros(a, free_steps)
    out = np.zeros(len(FORCE_CHANNELS))
    for i in range(len(out) if len(t) > 2 else 0):
        line, variance = np.polyfit(t, means[:, i], 1, w=1 / errors[:, i], cov="unscaled")
        straight = np.abs(means[:, i] - np.polyval(line, t)) < SURE * errors[:, i]
        out[i] = line[0] if straight.all() and abs(line[0]) > SURE * np.sqrt(variance[0, 0]) else 0.0
    return out


def without_drift(one: TrialAlignment, drift: np.ndarray) -> TrialAlignment:
    """The trial less a drift (4,) of its forces' zeros [N/s]."""
    since = one.trial.t - one.trial.t.mean()
    ours = {f: one.trial.channels[f] - since * d for f, d in zip(FORCE_CHANNELS, drift, strict=True)}
    trial = replace(one.trial, channels=one.trial.channels | ours)
    return replace(one, trial=trial, signals=replace(one.signals, **ours))


def _moved_zero(a: WeighedTrial, free_steps: Sequence[int], rig: Rig) -> np.ndarray:
    """Largest deviation (4,) [N] of forces in half a free stretch from the mean of all; 0 if due to noise."""
    _, means, errors = _zeros(a, free_steps)
    allowed = SURE * np.hypot(errors.max(axis=0) + errors, rig.systematic.force_bias)
    off = np.abs(means - means.mean(axis=0))
    return np.where((off > allowed).any(axis=0), off.max(axis=0), 0.0)


def level_rises(raw: np.ndarray, rises: dict[int, Terms]) -> dict[int, float]:
    """Mean recorded rise [m] of the moves that should be level, where recorded."""
    level = {move: raw[:, :, move, RISE] for move, rise in rises.items() if not rise}
    return {move: float(np.nanmean(r)) for move, r in level.items() if np.isfinite(r).any()}


BIASED = 0.0025  # prior: share of forces with a wrong nominal zero: all four in one recording in a hundred


def unexpected_bias(mean: np.ndarray, variance: np.ndarray, rig: Rig) -> np.ndarray:
    """Extra prior sd (4,) of force biases [N] that free motion shows and the rig does not admit. Forces in
    free motion should vanish, up to noise and the rig's own [systematic]. A bias as wide as their pooled mean
    explains that better by (z^2 - 1) / 2 - log z nats; it is allowed if that makes it probable."""
    precision = 1.0 / variance
    total = np.maximum(precision.sum(axis=0), np.finfo(float).tiny)  # a force that is never read has none
    pooled = (mean * precision).sum(axis=0) / total
    allowed = np.hypot(1.0 / np.sqrt(total), np.asarray(rig.systematic.force_bias))
    z = np.maximum(np.abs(pooled) / allowed, 1.0)
    return np.where((z**2 - 1) / 2 - np.log(z) > np.log(1 / BIASED - 1), np.abs(pooled), 0.0)


@dataclass(frozen=True)
class Design:
    """Arrays of the linear-Gaussian core; K observations, Q unknowns, N deviations of the hand."""

    unknowns: tuple[Unknown, ...]
    nuisances: tuple[Nuisance, ...]
    mean: np.ndarray  # (K,) of the observations, drawn alignments combined
    variance: np.ndarray  # (K,) likewise
    coefficients: np.ndarray  # (K, Q)
    shifts: np.ndarray  # (K, N) per standard deviation of each deviation
    channel: np.ndarray  # (K,) index into CHANNELS
    unit: np.ndarray  # (K,) of the shares of model error
    trial: np.ndarray  # (K,) source
    move: np.ndarray  # (K,) source
    slope: np.ndarray  # (K,) whether a slope over the give, with the shares of the mean, rather than a mean
    free_mean: np.ndarray  # (num_trials, 4) forces in free motion
    free_variance: np.ndarray  # (num_trials, 4)
    free_shifts: np.ndarray  # (num_trials, 4, N)
    scale_count: np.ndarray  # (3,) samples behind each noise variance
    # (3,) by channel, the error common to all slopes and that of each
    slope_sd: np.ndarray = field(default_factory=lambda: np.full(len(observations.CHANNELS), SLOPE_SD))
    unexpected: tuple[Nuisance, ...] = ()  # force biases that free motion shows and the rig does not admit
    doubts: Mapping[str, PadDoubt] = field(
        default_factory=lambda: dict.fromkeys(("normal", "shear"), PadDoubt())
    )
    level_rises: dict[int, float] = field(default_factory=dict)  # [m] mean, of moves between equal heights
    # (4,) [N] how far the forces' zeros move within a trial
    moved: np.ndarray = field(default_factory=lambda: np.zeros(len(FORCE_CHANNELS)))

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(object, property) of every unknown."""
        return tuple(u.name for u in self.unknowns)

    def repeats(self) -> np.ndarray:
        """By channel (3,): number of means in excess of the unknowns, which determine the scatter."""
        counts = np.bincount(self.channel[~self.slope], minlength=len(observations.CHANNELS))
        return counts - np.bincount([PROPERTIES.index(u.prop) for u in self.unknowns], minlength=3)


def build(aligned: AlignedTrials, weighed: Sequence[WeighedTrial], noise: Noise) -> Design:
    """Design of aligned trials, `weighed` by `estimation.observations`."""
    task, rig, trials = aligned.task, aligned.rig, [one.trial for one in aligned.trials]
    moves = list(range(len(task.performed)))
    objects = [task.performed[m].object for m in moves]
    rises = dict(height_equations(task))
    raw = np.stack([observe(a.signals, a, rig, moves) for a in weighed])  # T, S, M, 3
    variance = np.stack([sampling_variance(a, noise, moves) for a in weighed])
    factor = np.stack(
        [[a.grips[m]["force"] @ observations.gravity_factor(a.signals, rig) for m in moves] for a in weighed]
    )
    valid = np.isfinite(raw) & np.isfinite(variance)
    there = valid.mean(axis=1) > 0.5  # of the alignments
    # No property enters the rise of a move between equal heights.
    there[:, :, RISE] &= np.array([bool(rises[m]) for m in moves])
    unknowns = determined(task, objects, rises, there.any(axis=0))
    columns = coefficients_of(unknowns, objects, rises)  # M, 3, Q
    coefficients = np.repeat(np.repeat(columns[None, None], raw.shape[1], axis=1), len(trials), axis=0)
    coefficients[:, :, :, FORCE] *= np.swapaxes(factor, 1, 2)[..., None]
    free_steps = [step.index for step in aligned.subtasks if step.state == FREE]
    free_mean, free_variance, moved = free_means(weighed, noise, free_steps, rig)
    surprise = np.maximum(unexpected_bias(free_mean, free_variance, rig), moved)
    slopes = np.stack([observe_slopes(a.signals, a, rig, moves) for a in weighed])  # T, M, K
    sloped = np.array([channel for channel, _ in SLOPES.values()])
    slopes[..., ~there.any(axis=(0, 1))[sloped]] = np.nan  # channels that determine no unknown
    slope_variance, alike = map(np.stack, zip(*(slope_variances(a, moves) for a in weighed), strict=True))
    doubts = pad_doubts(slopes, slope_variance, alike, weighed, rig)
    slope_sd = np.array([SLOPE_SD, *(doubt.slope_sd for doubt in doubts.values())])
    slope_variance += slope_sd[sloped] ** 2
    deviations = nuisances(rig, surprise, doubts, max(trial.touch_sd for trial in trials))
    surprising = {f"force_bias.{name}" for name, sd in zip(FORCE_CHANNELS, surprise, strict=True) if sd}
    shifts = np.zeros((*there.shape, len(deviations)))
    slope_shifts = np.zeros((*slopes.shape, len(deviations)))
    free_shifts = np.zeros((*free_mean.shape, len(deviations)))
    for j, deviation in enumerate(deviations):
        for i, (trial, a) in enumerate(zip(trials, weighed, strict=True)):
            rate = 1.001 / float(np.median(np.diff(a.signals.t)))  # thins into the same groups of samples
            read, per = thin(deviation.read(trial, rig, deviation.step), rate), deviation.sd / deviation.step
            shifts[i, ..., j] = np.nan_to_num(raw[i] - observe(read, a, rig, moves)).mean(axis=0) * per
            slope_shifts[i, ..., j] = np.nan_to_num(slopes[i] - observe_slopes(read, a, rig, moves)) * per
            free_shifts[i, :, j] = (free_mean[i] - observations.free_forces(read, a)) * per
    where, steep = np.nonzero(there), np.nonzero(np.isfinite(slopes))
    mean, spread, rows = _combined(raw, variance, valid, coefficients, where)
    rows = np.concatenate([rows, np.zeros((steep[0].size, len(unknowns)))])
    shifts = np.concatenate([shifts[where], slope_shifts[steep]])
    counts = [noise.count["force"], noise.count["distance"], noise.count["pickup"] + noise.count["place"]]
    return Design(
        unknowns=unknowns, nuisances=deviations, mean=np.concatenate([mean, slopes[steep]]),
        variance=np.concatenate([spread, slope_variance[steep]]), coefficients=rows, shifts=shifts,
        channel=np.concatenate([where[2], sloped[steep[2]]]),
        unit=np.concatenate([units(weighed, raw, rig)[where], np.ones(steep[0].size)]),
        trial=np.concatenate([where[0], steep[0]]), move=np.concatenate([where[1], steep[1]]),
        slope=np.repeat([False, True], [where[0].size, steep[0].size]),
        free_mean=free_mean, free_variance=free_variance, free_shifts=free_shifts,
        scale_count=np.array(counts), slope_sd=slope_sd,
        unexpected=tuple(d for d in deviations if d.name in surprising), moved=moved,
        doubts=doubts, level_rises=level_rises(raw, rises),
    )  # fmt: skip


def _combined(
    raw: np.ndarray,
    variance: np.ndarray,
    valid: np.ndarray,
    coefficients: np.ndarray,
    where: tuple[np.ndarray, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances (K,) and coefficients (K, Q) of the observations. Drawn alignments are imputations:
    their variance is that within one plus 1 + 1 / S times that between them (Rubin 1987, equation 3.1.5),
    without what follows from the coefficients of a longer or shorter span."""
    used = np.moveaxis(valid, 1, -1)[where]  # K, S
    num = used.sum(axis=1)

    def average(values: np.ndarray) -> np.ndarray:
        return np.where(used, values, 0.0).sum(axis=1) / num

    values, rows = np.moveaxis(raw, 1, -1)[where], np.moveaxis(coefficients, 1, -2)[where]
    mean, within = average(values), average(np.moveaxis(variance, 1, -1)[where])
    row = np.where(used[..., None], rows, 0.0).sum(axis=1) / num[:, None]
    sd = np.sqrt(within)
    found, *_ = np.linalg.lstsq(row / sd[:, None], mean / sd, rcond=None)
    predicted = rows @ found
    shift = values - predicted - average(values - predicted)[:, None]
    between = average(shift**2) * num / np.maximum(num - 1, 1)
    return mean, within + (1 + 1 / num) * between, row
