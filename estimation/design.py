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
from dataclasses import dataclass, field, replace

import numpy as np

from estimation.compliance import SLOPE_SD
from estimation.moments import (
    SLOPES,
    free_means,
    level_rises,
    observe,
    observe_slopes,
    pad_doubt,
    sampling_variance,
    slope_variances,
    unexpected_bias,
    units,
)
from estimation.nuisance import Nuisance, PadDoubt, nuisances
from estimation.observations import (
    CHANNELS,
    Noise,
    WeighedTrial,
    free_forces,
    gravity_factor,
)
from estimation.unknowns import FORCE, PROPERTIES, RISE, Unknown, coefficients_of, determined
from hmmseg.contact.decompose import FREE, height_equations
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.segmentation.emissions import thin


@dataclass(frozen=True)
class Design:
    """Arrays of the linear-Gaussian core; K observations, Q unknowns, N deviations of the hand.

    `mean`, `variance` (K,) of the observations, drawn alignments combined; `coefficients` (K, Q);
    `shifts` (K, N) per standard deviation of each deviation; `channel` (K,) indexes CHANNELS;
    `unit` (K,): what shares of model error are taken of; `trial`, `move` (K,): where it was seen;
    `slope` (K,): whether a slope over the give rather than a mean (its shares are those of the mean).
    `slope_sd` (3,): by channel, the error that all slopes have alike and each has of its own.
    `free_mean`, `free_variance` (num_trials, 4) and `free_shifts` (num_trials, 4, N): forces in
    free motion. `scale_count` (3,): samples behind each noise variance; `unexpected`: force biases
    that free motion shows and the rig does not admit, `doubt`: the like of the pads; `level_rises`: by
    move between equal heights, the mean rise that was recorded [m]; `moved` (4,): by how much the zeros
    of forces move within a trial [N].
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
    slope_sd: np.ndarray = field(default_factory=lambda: np.full(len(CHANNELS), SLOPE_SD))
    unexpected: tuple[Nuisance, ...] = ()
    doubt: PadDoubt = field(default_factory=PadDoubt)
    level_rises: dict[int, float] = field(default_factory=dict)
    moved: np.ndarray = field(default_factory=lambda: np.zeros(len(FORCE_CHANNELS)))

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(object, property) of every unknown."""
        return tuple(u.name for u in self.unknowns)

    def repeats(self) -> np.ndarray:
        """By channel (3,): means beyond the unknowns they determine, all that tell scatter."""
        counts = np.bincount(self.channel[~self.slope], minlength=len(CHANNELS))
        return counts - np.bincount([PROPERTIES.index(u.prop) for u in self.unknowns], minlength=3)


def build(
    aligned: AlignedTrials, weighed: Sequence[WeighedTrial], noise: Noise, doubted: bool | None = None
) -> Design:
    """Design of aligned trials, `weighed` by `estimation.observations`.

    `doubted`: whether the rig's pads are in doubt by what slopes say against them; None: if that is likelier.
    """
    task, rig, trials = aligned.task, aligned.rig, [one.trial for one in aligned.trials]
    moves = list(range(len(task.performed)))
    objects = [task.performed[m].object for m in moves]
    rises = dict(height_equations(task))
    raw = np.stack([observe(a.signals, a, rig, moves) for a in weighed])  # T, S, M, 3
    variance = np.stack([sampling_variance(a, noise, moves) for a in weighed])
    factor = np.stack(
        [[a.weights.grips[m]["force"] @ gravity_factor(a.signals, rig) for m in moves] for a in weighed]
    )
    valid = np.isfinite(raw) & np.isfinite(variance)
    there = valid.mean(axis=1) > 0.5  # of the alignments
    # A move between equal heights has a rise that no property enters: it says nothing of them.
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
    slopes[..., ~there.any(axis=(0, 1))[sloped]] = np.nan  # of channels that tell no unknown
    slope_variance, alike = (
        np.stack(each) for each in zip(*(slope_variances(a, moves) for a in weighed), strict=True)
    )
    doubt = pad_doubt(slopes, slope_variance, alike, weighed, rig)
    doubt = replace(doubt, doubted=max(doubt.odds) > 0.5 if doubted is None else doubted)
    slope_variance += doubt.slope_sd()[sloped] ** 2
    deviations = nuisances(rig, surprise, doubt, max(trial.touch_sd for trial in trials))
    surprising = {f"force_bias.{name}" for name, sd in zip(FORCE_CHANNELS, surprise, strict=True) if sd}
    shifts = np.zeros((*there.shape, len(deviations)))
    slope_shifts = np.zeros((*slopes.shape, len(deviations)))
    free_shifts = np.zeros((*free_mean.shape, len(deviations)))
    for j, deviation in enumerate(deviations):
        for i, (trial, a) in enumerate(zip(trials, weighed, strict=True)):
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
        channel=np.concatenate([where[2], sloped[steep[2]]]),
        unit=np.concatenate([units(weighed, raw, rig)[where], np.ones(steep[0].size)]),
        trial=np.concatenate([where[0], steep[0]]), move=np.concatenate([where[1], steep[1]]),
        slope=np.repeat([False, True], [where[0].size, steep[0].size]),
        free_mean=free_mean, free_variance=free_variance, free_shifts=free_shifts,
        scale_count=np.array(counts), slope_sd=doubt.slope_sd(),
        unexpected=tuple(d for d in deviations if d.name in surprising), moved=moved,
        doubt=doubt, level_rises=level_rises(raw, rises),
    )  # fmt: skip


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


def _rate(signals: Signals) -> float:
    """A rate at which thinning groups samples as it did for these signals."""
    return 1.0 / float(np.median(np.diff(signals.t))) * 1.001
