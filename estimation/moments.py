"""Means and slopes of aligned trials with their variances, and what they say against the rig."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.combinations import Terms
from estimation.compliance import shear_give, squeeze_give, unexpected_share, unit_pads
from estimation.nuisance import PadDoubt
from estimation.observations import (
    CHANNELS,
    Aligned,
    Noise,
    channel_values,
    free_forces,
)
from estimation.unknowns import DISTANCE, FORCE, RISE
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig

READINGS = {DISTANCE: "distance", RISE: "place"}  # the samples whose slopes show the pads


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


def slope_variances(aligned: Aligned, moves: Sequence[int]) -> np.ndarray:
    """Variances (num_moves, 3) of the slopes, infinite of none."""
    found = [[aligned.weights.slopes.get(m, {}).get(name) for name in CHANNELS] for m in moves]
    return np.array([[np.inf if s is None else s.variance for s in row] for row in found])


def pad_doubt(slopes: np.ndarray, variance: np.ndarray, aligned: Sequence[Aligned], rig: Rig) -> PadDoubt:
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


def sampling_variance(aligned: Aligned, noise: Noise, moves: Sequence[int]) -> np.ndarray:
    """Sampling variance (num_alignments, num_moves, 3) of the means, infinite of none."""
    out = []
    with np.errstate(divide="ignore"):
        for move in moves:
            part = {k: noise.variance[k] / n for k, n in aligned.weights.counts[move].items()}
            out.append([part["force"], part["distance"], part["pickup"] + part["place"]])
    return np.moveaxis(np.array(out), 2, 0)


def units(aligned: Sequence[Aligned], raw: np.ndarray, rig: Rig) -> np.ndarray:
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


def free_means(aligned: Sequence[Aligned], noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Mean forces in free motion (num_trials, 4) and their variances."""
    mean = np.stack([free_forces(a.signals, a) for a in aligned])
    count = np.array([max(a.weights.free_count, 1.0) for a in aligned])
    variance = np.array([noise.variance[name] for name in FORCE_CHANNELS])
    return mean, variance[None, :] / count[:, None]


def level_rises(raw: np.ndarray, rises: dict[int, Terms]) -> dict[int, float]:
    """Mean recorded rise [m] of the moves that should have none, where they were recorded."""
    out = {}
    for move, rise in rises.items():
        recorded = raw[:, :, move, RISE]
        recorded = recorded[np.isfinite(recorded)]
        if not rise and recorded.size:
            out[move] = float(recorded.mean())
    return out


def unexpected_bias(mean: np.ndarray, variance: np.ndarray, rig: Rig) -> np.ndarray:
    """Extra prior sd (4,) of force biases that free motion shows and the rig does not admit [N].

    Forces in free motion should vanish; where their pooled mean is beyond 4 standard errors of
    what noise and the rig's own [systematic] allow, the bias gets a prior as wide as itself.
    """
    precision = 1.0 / variance
    pooled = (mean * precision).sum(axis=0) / precision.sum(axis=0)
    allowed = np.hypot(1.0 / np.sqrt(precision.sum(axis=0)), np.asarray(rig.systematic.force_bias))
    return np.where(np.abs(pooled) > 4 * allowed, np.abs(pooled), 0.0)
