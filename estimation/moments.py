"""Means and slopes of aligned trials with their variances, and what they say against the rig."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimation.combinations import Terms
from estimation.compliance import (
    middle_share,
    misstated,
    possible_share,
    shared_error,
    shear_give,
    squeeze_give,
    unit_pads,
)
from estimation.nuisance import PadDoubt
from estimation.observations import (
    MIN_FREE,
    Noise,
    WeighedTrial,
    channel_values,
    free_forces,
)
from estimation.unknowns import DISTANCE, FORCE, RISE
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.levels import SURE

ZERO_SHARE = 0.05  # limit: of the largest force: a zero that moves by less matters less than other errors

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
    surest = {DISTANCE: (0.0, np.inf), RISE: (0.0, np.inf)}
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
            if one[0].size:
                middle, error = middle_share(one[0], one[1], 0.0)
                surest[channel] = min(surest[channel], (middle, float(np.hypot(error, apart))), key=sd_of)
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
        seen=((-surest[DISTANCE][0], surest[DISTANCE][1]), surest[RISE]),
    )  # fmt: skip


def sd_of(found: tuple[float, float]) -> float:
    """The second of a value and its standard deviation."""
    return found[1]


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
    with np.errstate(divide="ignore", invalid="ignore"):  # of a channel without readings
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


def free_means(
    weighed: Sequence[WeighedTrial], noise: Noise, free_steps: Sequence[int], rig: Rig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean forces in free motion (num_trials, 4), their variances, and how far each zero moves (4,) [N].

    A zero that moves between the free stretches of a trial (subtasks `free_steps`), beyond what noise and
    the rig's own bias allow, is no better known in a grip than these stretches differ.
    """
    mean = np.stack([free_forces(a.signals, a) for a in weighed])
    count = np.array([max(a.weights.free_count, 1.0) for a in weighed])
    of_sample = np.array([noise.variance[name] for name in FORCE_CHANNELS])
    variance = of_sample[None, :] / count[:, None]
    moved = np.stack([_moved_zero(a, free_steps, of_sample, rig) for a in weighed])
    return mean, variance + moved**2, moved.max(axis=0)


def _moved_zero(a: WeighedTrial, free_steps: Sequence[int], variance: np.ndarray, rig: Rig) -> np.ndarray:
    """How far (4,) [N] a free stretch's forces are from the mean of all, at most; 0 if by noise."""
    out = np.zeros(len(FORCE_CHANNELS))
    spans = [np.asarray(a.masks[:, k].mean(axis=0) > 0.5) & (a.weights.free > 0) for k in free_steps]
    for i, name in enumerate(FORCE_CHANNELS):
        force = getattr(a.signals, name)
        pieces = [force[span & np.isfinite(force)] for span in spans]
        pieces = [piece for piece in pieces if piece.size >= MIN_FREE]
        if len(pieces) < 2:
            continue
        middles = np.array([np.median(piece) for piece in pieces])
        errors = np.sqrt(np.array([variance[i] / piece.size for piece in pieces]))
        allowed = SURE * np.hypot(errors.max() + errors, rig.systematic.force_bias[i])
        off = np.abs(middles - middles.mean())
        if (off > allowed).any() and off.max() > ZERO_SHARE * float(np.nanmax(np.abs(force))):
            out[i] = off.max()
    return out


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
