"""The linear-Gaussian core of the properties' likelihood, assembled from aligned trials.

Observation o of trial t under its drawn alignment s is a mean over samples,

    mean[t, s, o] = A[t, s, o] . properties + J[t, s, o] . deviations + noise,

with noise variance scale_c^2 v_c / n[t, s, o] + tau_c^2 for its channel c: A holds gravity factors
(force), ones (distance) and height coefficients (rise), J finite differences through the hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estimation.nuisance import Nuisance, nuisances
from estimation.observations import Aligned, Noise, channel_values, gravity_factor
from hmmseg.contact.decompose import height_equations
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.features import thin

PROPERTIES = ("weight", "width", "height")


@dataclass(frozen=True)
class Design:
    """Arrays of the linear-Gaussian core; S alignments, O observations, P properties, N deviations.

    `mean`, `variance` (num_trials, S, O) with 0 weight where nothing was recorded (`there`);
    `coefficients` (num_trials, S, O, P), `shifts` (num_trials, S, O, N) per standard deviation of
    each deviation; `channel` (O,) indexes CHANNELS. `free_mean`, `free_variance` (num_trials, 4)
    and `free_shifts` (num_trials, 4, N): forces in free motion. `tau` (3,): prior median of the
    trial-to-trial standard deviation; `common` (3,): standard deviation of what the model leaves
    out alike in all trials; `scale_count` (3,): samples behind each noise variance; `unexpected`:
    force biases that free motion shows and the rig does not admit; `level_rises`: by move between
    equal heights, the mean rise that was recorded [m].
    """

    names: tuple[tuple[str, str], ...]
    nuisances: tuple[Nuisance, ...]
    mean: np.ndarray
    variance: np.ndarray
    there: np.ndarray
    coefficients: np.ndarray
    shifts: np.ndarray
    channel: np.ndarray
    free_mean: np.ndarray
    free_variance: np.ndarray
    free_shifts: np.ndarray
    tau: np.ndarray
    common: np.ndarray
    scale_count: np.ndarray
    unexpected: tuple[Nuisance, ...] = ()
    level_rises: dict[int, float] = field(default_factory=dict)


# Trial-to-trial scatter and what the model leaves out, in units of one sample's noise: how far
# contact mechanics holds below the sensors' resolution. Measured on recordings and simulations by
# experiments/calibration.py; docs/model.md says how.
TAU_SHARE = np.array([0.03, 0.05, 0.15])
COMMON_SHARE = np.array([0.02, 0.01, 0.25])


def observe(signals: Signals, aligned: Aligned, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Observed means (num_alignments, num_moves * 3) of one trial, NaN where nothing was recorded."""
    values = channel_values(signals, rig)
    out = []
    for move in moves:
        weights, counts = aligned.weights.grips[move], aligned.weights.counts[move]
        means = {k: _mean(w, values[k], counts[k]) for k, w in weights.items()}
        out += [means["force"], means["distance"], means["place"] - means["pickup"]]
    return np.stack(out, axis=1)


def _mean(weights: np.ndarray, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.where(counts > 0, weights @ np.nan_to_num(values), np.nan)


def _free_forces(signals: Signals, aligned: Aligned) -> np.ndarray:
    force = np.stack([getattr(signals, name) for name in FORCE_CHANNELS])
    return np.nan_to_num(force) @ aligned.weights.free


def build(
    trials: Sequence[Trial], aligned: Sequence[Aligned], noise: Noise, task: BlockTask, rig: Rig,
    sd_force: float,
) -> Design:  # fmt: skip
    """Design of the given aligned trials. `sd_force`: noise of one force sample [N]."""
    moves = list(range(len(task.performed)))
    rises = dict(height_equations(task))
    raw = np.stack([observe(a.signals, a, rig, moves) for a in aligned])
    channel = np.tile(np.arange(3), len(moves))
    columns = [(obj, prop) for obj in task.objects for prop in PROPERTIES]
    coefficients = np.zeros((*raw.shape, len(columns)))
    variance = np.full(raw.shape, np.inf)
    for i, a in enumerate(aligned):
        factor = gravity_factor(a.signals, rig)
        for m, move in enumerate(moves):
            obj, w, n = task.performed[move].object, a.weights.grips[move], a.weights.counts[move]
            force, distance, rise = 3 * m, 3 * m + 1, 3 * m + 2
            coefficients[i, :, force, columns.index((obj, "weight"))] = w["force"] @ factor
            coefficients[i, :, distance, columns.index((obj, "width"))] = 1.0
            for other, c in rises[move].items():
                coefficients[i, :, rise, columns.index((other, "height"))] = c
            with np.errstate(divide="ignore"):
                variance[i, :, force] = noise.variance["force"] / n["force"]
                variance[i, :, distance] = noise.variance["distance"] / n["distance"]
                v_pickup = noise.variance["pickup"] / n["pickup"]
                variance[i, :, rise] = v_pickup + noise.variance["place"] / n["place"]
    # A move between equal heights has a rise that no property enters: it says nothing of them.
    there = np.isfinite(raw) & np.isfinite(variance) & coefficients.any(axis=-1)
    free_mean = np.stack([_free_forces(a.signals, a) for a in aligned])
    free_count = np.array([max(a.weights.free_count, 1.0) for a in aligned])
    free_variance = np.repeat((sd_force**2 / free_count)[:, None], 4, axis=1)
    surprise = unexpected_bias(free_mean, free_variance, rig)
    deviations = nuisances(rig, surprise)
    surprising = {f"force_bias.{name}" for name, sd in zip(FORCE_CHANNELS, surprise, strict=True) if sd}
    shifts = np.zeros((*raw.shape, len(deviations)))
    free_shifts = np.zeros((*free_mean.shape, len(deviations)))
    for j, deviation in enumerate(deviations):
        for i, (trial, a) in enumerate(zip(trials, aligned, strict=True)):
            read = thin(deviation.read(trial, rig, deviation.step), _rate(a.signals))
            slope = (raw[i] - observe(read, a, rig, moves)) / deviation.step
            shifts[i, :, :, j] = np.nan_to_num(slope) * deviation.sd
            slope = (free_mean[i] - _free_forces(read, a)) / deviation.step
            free_shifts[i, :, j] = slope * deviation.sd
    determined = _determined(coefficients, there)
    sample = np.sqrt([noise.variance["force"], noise.variance["distance"], noise.variance["place"]])
    counts = [noise.count["force"], noise.count["distance"], noise.count["pickup"] + noise.count["place"]]
    return Design(
        names=tuple(c for c, known in zip(columns, determined, strict=True) if known),
        nuisances=deviations, mean=np.where(there, raw, 0.0), variance=np.where(there, variance, 1.0),
        there=there, coefficients=coefficients[..., determined], shifts=shifts, channel=channel,
        free_mean=free_mean, free_variance=free_variance, free_shifts=free_shifts,
        tau=TAU_SHARE * sample, common=COMMON_SHARE * sample, scale_count=np.array(counts),
        unexpected=tuple(d for d in deviations if d.name in surprising),
        level_rises=_level_rises(raw, rises),
    )  # fmt: skip


def _level_rises(raw: np.ndarray, rises: dict[int, dict[str, int]]) -> dict[int, float]:
    """Mean recorded rise [m] of the moves that should have none, where they were recorded."""
    out = {}
    for move, rise in rises.items():
        recorded = raw[:, :, 3 * move + 2]
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


def _determined(coefficients: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Which properties (P,) the recorded observations fix, by the rank of the linear system."""
    rows = (coefficients * there[..., None]).reshape(-1, coefficients.shape[-1])
    _, singular, vt = np.linalg.svd(rows, full_matrices=True)
    rank = int((singular > 1e-9).sum())
    return np.abs(vt[rank:]).max(axis=0, initial=0.0) < 1e-9
