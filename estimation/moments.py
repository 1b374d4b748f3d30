"""Means and slopes of aligned trials with their variances, and what they say against the rig."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.combinations import Terms
from estimation.compliance import (
    misstated,
    possible_share,
    shared_error,
    shear_give,
    squeeze_give,
    unit_pads,
)
from estimation.nuisance import PadDoubt
from estimation.observations import (
    Noise,
    WeighedTrial,
    channel_values,
    free_forces,
)
from estimation.unknowns import DISTANCE, FORCE, RISE
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig

# Slopes that show the pads, by their names in `Weights.slopes`: the channel they are of, whose samples.
SLOPES = {"distance": (DISTANCE, "distance"), "rise": (RISE, "place"), "landing": (RISE, "place")}


def observe(signals: Signals, weighed: WeighedTrial, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Observed means (num_alignments, num_moves, 3) of one trial, NaN where nothing was recorded."""
    values = channel_values(signals, rig)
    out = []
    for move in moves:
        weights, counts = weighed.weights.grips[move], weighed.weights.counts[move]
        means = {k: _mean(w, values[k], counts[k]) for k, w in weights.items()}
        out.append([means["force"], means["distance"], means["place"] - means["pickup"]])
    return np.moveaxis(np.array(out), 2, 0)


def observe_slopes(signals: Signals, weighed: WeighedTrial, rig: Rig, moves: Sequence[int]) -> np.ndarray:
    """Slopes of readings over the pads' give (num_moves, len(SLOPES)) of one trial, NaN where none."""
    values, out = channel_values(signals, rig), np.full((len(moves), len(SLOPES)), np.nan)
    for i, move in enumerate(moves):
        for k, (name, (_, reading)) in enumerate(SLOPES.items()):
            found = weighed.weights.slopes.get(move, {}).get(name)
            if found is not None:
                out[i, k] = found.weights @ np.nan_to_num(values[reading])
    return out


def slope_variances(weighed: WeighedTrial, moves: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Variances (num_moves, len(SLOPES)) of slopes, infinite of none, and what they may be off by alike."""
    found = [[weighed.weights.slopes.get(m, {}).get(name) for name in SLOPES] for m in moves]
    variance = [[np.inf if s is None else s.variance for s in row] for row in found]
    return np.array(variance), np.array([[0.0 if s is None else s.alike for s in row] for row in found])


def pad_doubt(
    slopes: np.ndarray, variance: np.ndarray, alike: np.ndarray, weighed: Sequence[WeighedTrial], rig: Rig
) -> PadDoubt:
    """What slopes (num_trials, num_moves, len(SLOPES)) say against the rig's pads, and usual forces.

    `variance`, `alike`: as in `slope_variances`, of all trials. A share that several kinds of slope find is
    that of the surest of them.
    """
    admitted = float(np.hypot(*rig.systematic.pad_stiffness)) / 2
    found, possible, shared = {}, {DISTANCE: 0.0, RISE: 0.0}, {}
    for channel, stiffness in (
        (DISTANCE, rig.fingertip.normal_stiffness), (RISE, rig.fingertip.shear_stiffness),
    ):  # fmt: skip
        stated = bool(np.isfinite(stiffness))
        kinds = [k for k, (c, _) in enumerate(SLOPES.values()) if c == channel]
        seen = np.isfinite(slopes[..., kinds])
        mine = [values[..., kinds][seen] for values in (slopes, variance, alike)]
        shared[channel] = shared_error(mine[2], mine[1])
        found[channel] = (0.0, 0.0)
        for k in kinds:
            of_kind = np.isfinite(slopes[..., k])
            one = [values[..., k][of_kind] for values in (slopes, variance, alike)]
            apart = shared_error(one[2], one[1])
            said = misstated(one[0], one[1], stated, admitted if stated else 0.0, apart)
            found[channel] = max(found[channel], said, key=lambda share_and_odds: share_and_odds[1])
        if not stated:
            possible[channel] = possible_share(mine[0], mine[1])
    normal, shear = (
        float(np.median(np.concatenate(forces))) for forces in zip(*map(_usual, weighed), strict=True)
    )
    # A width reads too small by the share of the give that the rig leaves out, a height too large.
    return PadDoubt(
        -found[DISTANCE][0], found[RISE][0], possible[DISTANCE], possible[RISE], normal, shear,
        (found[DISTANCE][1], found[RISE][1]), apart=(shared[DISTANCE], shared[RISE]),
    )  # fmt: skip


def _usual(weighed: WeighedTrial) -> tuple[np.ndarray, np.ndarray]:
    """Mean forces of one finger (num_moves,) along the grip, and in shear where the block is put down [N]."""
    s, grips = weighed.signals, weighed.weights.grips.values()
    along, up = np.nan_to_num(s.fx1 - s.fx2) / 2, np.nan_to_num(s.fy) / 2
    return np.array([np.mean(w["distance"] @ along) for w in grips]), np.array(
        [abs(np.mean(w["place"] @ up)) for w in grips]
    )


def _mean(weights: np.ndarray, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.where(counts > 0, weights @ np.nan_to_num(values), np.nan)


def sampling_variance(weighed: WeighedTrial, noise: Noise, moves: Sequence[int]) -> np.ndarray:
    """Sampling variance (num_alignments, num_moves, 3) of the means, infinite of none."""
    out = []
    with np.errstate(divide="ignore"):
        for move in moves:
            part = {k: noise.variance[k] / n for k, n in weighed.weights.counts[move].items()}
            out.append([part["force"], part["distance"], part["pickup"] + part["place"]])
    return np.moveaxis(np.array(out), 2, 0)


def units(weighed: Sequence[WeighedTrial], raw: np.ndarray, rig: Rig) -> np.ndarray:
    """What shares of model error are taken of (num_trials, num_moves, 3) [N, m, m].

    Of a rise at least the give under the weight, and what it changed by in landing: what a pad does on
    its way from one to the other need not cancel where contact forces balance.
    """
    force = np.abs(raw[..., FORCE]).mean(axis=1)
    force = np.where(np.isfinite(force), force, np.nanmean(force) if np.isfinite(force).any() else 1.0)
    grip, lever, landed = [], [], []
    for a in weighed:
        squeeze, shear = (np.nan_to_num(give(a.signals, rig)) for give in (squeeze_give, shear_give))
        grips = a.weights.grips.values()
        grip.append([np.mean(w["distance"] @ squeeze) for w in grips])
        place = [np.mean(w["place"] @ shear) for w in grips]
        lever.append([p - np.mean(w["pickup"] @ shear) for p, w in zip(place, grips, strict=True)])
        landed.append([abs(p - np.mean(w["force"] @ shear)) for p, w in zip(place, grips, strict=True)])
    hanging = np.maximum(force, 1e-3) * (unit_pads(rig).shear1 + unit_pads(rig).shear2) / 4
    rise = np.array(lever)
    least = np.maximum(hanging, np.array(landed))
    rise = np.where(rise < 0, -1.0, 1.0) * np.maximum(np.abs(rise), least)
    return np.stack([force, np.maximum(grip, 1e-7), rise], axis=-1)


def free_means(weighed: Sequence[WeighedTrial], noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Mean forces in free motion (num_trials, 4) and their variances."""
    mean = np.stack([free_forces(a.signals, a) for a in weighed])
    count = np.array([max(a.weights.free_count, 1.0) for a in weighed])
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
