"""The linear-Gaussian core of the properties' likelihood, assembled from aligned trials.

Every grip of every trial gives up to three observations (`estimation.observations`), each in its
channel c:

    mean = A . unknowns + J . deviations + unit (common_c + own) + noise,

A holds gravity factors (force), ones (distance) and coefficients of heights (rise), J finite
differences through the hand. `unit` is the quantity that the channel's equation is built on: the
carried force, the pads' give along the grip, what their shear deflection differs by between pickup
and place. What the equation leaves out is stated as a share of it: one that all grips have in common,
one that differs from grip to grip. Beside the means stand slopes over the pads' give within a grip
(`estimation.compliance`), which show these shares themselves (unit 1), whatever the block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estimation.combinations import Terms, simplest_combinations
from estimation.compliance import shear_give, squeeze_give, unexpected_share, unit_pads
from estimation.nuisance import Nuisance, PadDoubt, nuisances
from estimation.observations import (
    CHANNELS,
    Aligned,
    Noise,
    channel_values,
    free_forces,
    gravity_factor,
)
from hmmseg.contact.decompose import height_equations
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.features import thin

PROPERTIES = ("weight", "width", "height")
FORCE, DISTANCE, RISE = range(len(CHANNELS))
READINGS = {DISTANCE: "distance", RISE: "place"}  # the samples whose slopes show the pads


@dataclass(frozen=True)
class Unknown:
    """What the recording determines: a property, or a combination of one property of several objects."""

    prop: str
    terms: Terms

    @property
    def single(self) -> bool:
        """Whether it is a property of one object."""
        return len(self.terms) == 1

    @property
    def name(self) -> tuple[str, str]:
        """(object, property); objects of a combination joined as in `b + c`."""
        text = ""
        for obj, c in self.terms.items():
            sign = " - " if c < 0 else " + "
            text += (sign if text else "") + (obj if abs(c) == 1 else f"{abs(c)} {obj}")
        return text, self.prop


@dataclass(frozen=True)
class Design:
    """Arrays of the linear-Gaussian core; K observations, Q unknowns, N deviations of the hand.

    `mean`, `variance` (K,) of the observations, drawn alignments combined; `coefficients` (K, Q);
    `shifts` (K, N) per standard deviation of each deviation; `channel` (K,) indexes CHANNELS;
    `unit` (K,): what shares of model error are taken of; `trial`, `move` (K,): where it was seen;
    `slope` (K,): whether a slope over the give rather than a mean (its shares are those of the mean).
    `free_mean`, `free_variance` (num_trials, 4) and `free_shifts` (num_trials, 4, N): forces in
    free motion. `scale_count` (3,): samples behind each noise variance; `unexpected`: force biases
    that free motion shows and the rig does not admit, `doubt`: the like of the pads; `level_rises`: by
    move between equal heights, the mean rise that was recorded [m].
    """

    unknowns: tuple[Unknown, ...]
    nuisances: tuple[Nuisance, ...]
    mean: np.ndarray
    variance: np.ndarray
    coefficients: np.ndarray
    shifts: np.ndarray
    channel: np.ndarray
    unit: np.ndarray
    trial: np.ndarray
    move: np.ndarray
    slope: np.ndarray
    free_mean: np.ndarray
    free_variance: np.ndarray
    free_shifts: np.ndarray
    scale_count: np.ndarray
    unexpected: tuple[Nuisance, ...] = ()
    doubt: PadDoubt = field(default_factory=PadDoubt)
    level_rises: dict[int, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(object, property) of every unknown."""
        return tuple(u.name for u in self.unknowns)

    def repeats(self) -> np.ndarray:
        """By channel (3,): means beyond the unknowns they determine, all that tell scatter."""
        counts = np.bincount(self.channel[~self.slope], minlength=len(CHANNELS))
        return counts - np.bincount([PROPERTIES.index(u.prop) for u in self.unknowns], minlength=3)


def observe(signals: Signals, aligned: Aligned, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Observed means (num_alignments, num_moves, 3) of one trial, NaN where nothing was recorded."""
    values = channel_values(signals, rig)
    out = []
    for move in moves:
        weights, counts = aligned.weights.grips[move], aligned.weights.counts[move]
        means = {k: _mean(w, values[k], counts[k]) for k, w in weights.items()}
        out.append([means["force"], means["distance"], means["place"] - means["pickup"]])
    return np.moveaxis(np.array(out), 2, 0)


def observe_slopes(signals: Signals, aligned: Aligned, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Slopes of readings over the pads' give (num_moves, 3) of one trial, NaN where there is none."""
    values, out = channel_values(signals, rig), np.full((len(moves), len(CHANNELS)), np.nan)
    for i, move in enumerate(moves):
        for c, reading in READINGS.items():
            found = aligned.weights.slopes.get(move, {}).get(CHANNELS[c])
            if found is not None:
                out[i, c] = found.weights @ np.nan_to_num(values[reading])
    return out


def _slope_variance(aligned: Aligned, moves: Sequence[int]) -> np.ndarray:
    """Variances (num_moves, 3) of the slopes, infinite of none."""
    found = [[aligned.weights.slopes.get(m, {}).get(name) for name in CHANNELS] for m in moves]
    return np.array([[np.inf if s is None else s.variance for s in row] for row in found])


def _pad_doubt(slopes: np.ndarray, variance: np.ndarray, aligned: Sequence[Aligned], rig: Rig) -> PadDoubt:
    """What slopes (num_trials, num_moves, 3) say against the rig's pads, and a usual grip force."""
    admitted = float(np.hypot(*rig.systematic.pad_stiffness)) / 2
    found = {}
    for c, stiffness in ((DISTANCE, rig.fingertip.normal_stiffness), (RISE, rig.fingertip.shear_stiffness)):
        seen = np.isfinite(slopes[..., c])
        stated = bool(np.isfinite(stiffness))
        found[c] = unexpected_share(
            slopes[..., c][seen], variance[..., c][seen], stated, admitted if stated else 0.0
        )
    squeeze = np.concatenate([_squeeze(a) for a in aligned])
    # A width reads too small by the share of the give that the rig leaves out, a height too large.
    return PadDoubt(-found[DISTANCE], found[RISE], max(float(np.median(squeeze)), 1e-3))


def _squeeze(aligned: Aligned) -> np.ndarray:
    """Mean grip force of one finger (num_moves,) [N]."""
    force = np.nan_to_num(aligned.signals.fx1 - aligned.signals.fx2) / 2
    return np.array([np.mean(w["distance"] @ force) for w in aligned.weights.grips.values()])


def _mean(weights: np.ndarray, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.where(counts > 0, weights @ np.nan_to_num(values), np.nan)


def build(
    trials: Sequence[Trial], aligned: Sequence[Aligned], noise: Noise, task: BlockTask, rig: Rig
) -> Design:
    """Design of the given aligned trials."""
    moves = list(range(len(task.performed)))
    objects = [task.performed[m].object for m in moves]
    rises = dict(height_equations(task))
    raw = np.stack([observe(a.signals, a, rig, moves) for a in aligned])  # T, S, M, 3
    variance = np.stack([_variance(a, noise, moves) for a in aligned])
    factor = np.stack(
        [[a.weights.grips[m]["force"] @ gravity_factor(a.signals, rig) for m in moves] for a in aligned]
    )
    valid = np.isfinite(raw) & np.isfinite(variance)
    there = valid.mean(axis=1) > 0.5  # of the alignments
    # A move between equal heights has a rise that no property enters: it says nothing of them.
    there[:, :, RISE] &= np.array([bool(rises[m]) for m in moves])
    unknowns = _unknowns(task, objects, rises, there.any(axis=0))
    columns = _columns(unknowns, objects, rises)  # M, 3, Q
    coefficients = np.repeat(np.repeat(columns[None, None], raw.shape[1], axis=1), len(trials), axis=0)
    coefficients[:, :, :, FORCE] *= np.swapaxes(factor, 1, 2)[..., None]
    free_mean, free_variance = _free(aligned, noise)
    surprise = unexpected_bias(free_mean, free_variance, rig)
    slopes = np.stack([observe_slopes(a.signals, a, rig, moves) for a in aligned])  # T, M, 3
    slopes[..., ~there.any(axis=(0, 1))] = np.nan  # of channels that tell no unknown
    slope_variance = np.stack([_slope_variance(a, moves) for a in aligned])
    doubt = _pad_doubt(slopes, slope_variance, aligned, rig)
    deviations = nuisances(rig, surprise, doubt, max(trial.touch_sd for trial in trials))
    surprising = {f"force_bias.{name}" for name, sd in zip(FORCE_CHANNELS, surprise, strict=True) if sd}
    shifts = np.zeros((*there.shape, len(deviations)))
    slope_shifts = np.zeros((*there.shape, len(deviations)))
    free_shifts = np.zeros((*free_mean.shape, len(deviations)))
    for j, deviation in enumerate(deviations):
        for i, (trial, a) in enumerate(zip(trials, aligned, strict=True)):
            read, size = thin(deviation.read(trial, rig, deviation.step), _rate(a.signals)), deviation.sd
            change = np.nan_to_num(raw[i] - observe(read, a, rig, moves)).mean(axis=0) / deviation.step
            shifts[i, ..., j] = change * size
            change = np.nan_to_num(slopes[i] - observe_slopes(read, a, rig, moves)) / deviation.step
            slope_shifts[i, ..., j] = change * size
            free_shifts[i, :, j] = (free_mean[i] - free_forces(read, a)) / deviation.step * size
    where, steep = np.nonzero(there), np.nonzero(np.isfinite(slopes))
    mean, spread, rows = _combined(raw, variance, valid, coefficients, where)
    rows = np.concatenate([rows, np.zeros((steep[0].size, len(unknowns)))])
    shifts = np.concatenate([shifts[where], slope_shifts[steep]])
    counts = [noise.count["force"], noise.count["distance"], noise.count["pickup"] + noise.count["place"]]
    return Design(
        unknowns=unknowns, nuisances=deviations, mean=np.concatenate([mean, slopes[steep]]),
        variance=np.concatenate([spread, slope_variance[steep]]), coefficients=rows, shifts=shifts,
        channel=np.concatenate([where[2], steep[2]]),
        unit=np.concatenate([_units(aligned, raw, rig)[where], np.ones(steep[0].size)]),
        trial=np.concatenate([where[0], steep[0]]), move=np.concatenate([where[1], steep[1]]),
        slope=np.repeat([False, True], [where[0].size, steep[0].size]),
        free_mean=free_mean, free_variance=free_variance, free_shifts=free_shifts,
        scale_count=np.array(counts), unexpected=tuple(d for d in deviations if d.name in surprising),
        doubt=doubt, level_rises=_level_rises(raw, rises),
    )  # fmt: skip


def _variance(aligned: Aligned, noise: Noise, moves: Sequence[int]) -> np.ndarray:
    """Sampling variance (num_alignments, num_moves, 3) of the means, infinite of none."""
    out = []
    with np.errstate(divide="ignore"):
        for move in moves:
            part = {k: noise.variance[k] / n for k, n in aligned.weights.counts[move].items()}
            out.append([part["force"], part["distance"], part["pickup"] + part["place"]])
    return np.moveaxis(np.array(out), 2, 0)


def _unknowns(
    task: BlockTask, objects: Sequence[str], rises: dict[int, Terms], there: np.ndarray
) -> tuple[Unknown, ...]:
    """What the moves recorded in `there` (num_moves, 3) determine, objects in the task's order."""
    names = list(task.objects)
    held = {
        c: {obj for obj, seen in zip(objects, there[:, c], strict=True) if seen} for c in (FORCE, DISTANCE)
    }
    out = []
    recorded = [rises[m] for m, seen in enumerate(there[:, RISE]) if seen]
    heights = simplest_combinations(recorded, names)
    for name in names:
        out += [Unknown("weight", {name: 1})] * (name in held[FORCE])
        out += [Unknown("width", {name: 1})] * (name in held[DISTANCE])
        out += [Unknown("height", {name: 1})] * ({name: 1} in heights)
    return (*out, *(Unknown("height", terms) for terms in heights if len(terms) > 1))


def _columns(unknowns: Sequence[Unknown], objects: Sequence[str], rises: dict[int, Terms]) -> np.ndarray:
    """Coefficients (num_moves, 3, Q) of the unknowns in each observation of a move."""
    out = np.zeros((len(objects), len(CHANNELS), len(unknowns)))
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


def _combined(
    raw: np.ndarray, variance: np.ndarray, valid: np.ndarray, coefficients: np.ndarray, where: tuple
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, variances (K,) and coefficients (K, Q) of the observations, drawn alignments combined.

    Alignments are draws of what is missing, so the variance is that within one alignment plus
    1 + 1 / S times that between them (Rubin 1987, Multiple Imputation, equation 3.1.5). What a
    longer or shorter span changes in the coefficients is no difference between alignments.
    """
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


def _units(aligned: Sequence[Aligned], raw: np.ndarray, rig: Rig) -> np.ndarray:
    """What shares of model error are taken of (num_trials, num_moves, 3) [N, m, m].

    Of a rise at least the give under the weight: contact forces that balance leave other errors.
    """
    force = np.abs(raw[..., FORCE]).mean(axis=1)
    force = np.where(np.isfinite(force), force, np.nanmean(force) if np.isfinite(force).any() else 1.0)
    grip, lever = [], []
    for a in aligned:
        squeeze, shear = (np.nan_to_num(give(a.signals, rig)) for give in (squeeze_give, shear_give))
        grips = a.weights.grips.values()
        grip.append([np.mean(w["distance"] @ squeeze) for w in grips])
        lever.append([np.mean(w["place"] @ shear) - np.mean(w["pickup"] @ shear) for w in grips])
    hanging = np.maximum(force, 1e-3) * (unit_pads(rig).shear1 + unit_pads(rig).shear2) / 4
    rise = np.array(lever)
    rise = np.where(rise < 0, -1.0, 1.0) * np.maximum(np.abs(rise), hanging)
    return np.stack([force, np.maximum(grip, 1e-7), rise], axis=-1)


def _free(aligned: Sequence[Aligned], noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Mean forces in free motion (num_trials, 4) and their variances."""
    mean = np.stack([free_forces(a.signals, a) for a in aligned])
    count = np.array([max(a.weights.free_count, 1.0) for a in aligned])
    variance = np.array([noise.variance[name] for name in FORCE_CHANNELS])
    return mean, variance[None, :] / count[:, None]


def _level_rises(raw: np.ndarray, rises: dict[int, Terms]) -> dict[int, float]:
    """Mean recorded rise [m] of the moves that should have none, where they were recorded."""
    out = {}
    for move, rise in rises.items():
        recorded = raw[:, :, move, RISE]
        recorded = recorded[np.isfinite(recorded)]
        if not rise and recorded.size:
            out[move] = float(recorded.mean())
    return out


def _rate(signals: Signals) -> float:
    """A rate at which thinning groups samples as it did for these signals."""
    return 1.0 / float(np.median(np.diff(signals.t))) * 1.001


def unexpected_bias(mean: np.ndarray, variance: np.ndarray, rig: Rig) -> np.ndarray:
    """Extra prior sd (4,) of force biases that free motion shows and the rig does not admit [N].

    Forces in free motion should vanish; where their pooled mean is beyond 4 standard errors of
    what noise and the rig's own [systematic] allow, the bias gets a prior as wide as itself.
    """
    precision = 1.0 / variance
    pooled = (mean * precision).sum(axis=0) / precision.sum(axis=0)
    allowed = np.hypot(1.0 / np.sqrt(precision.sum(axis=0)), np.asarray(rig.systematic.force_bias))
    return np.where(np.abs(pooled) > 4 * allowed, np.abs(pooled), 0.0)
