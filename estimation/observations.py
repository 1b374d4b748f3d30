"""What aligned trials say of the blocks: one robust mean a grip and channel, for many alignments.

Three observations a grip (the span from pickup to place of one move):

- `force`: mean net vertical force over the carry [N];
- `distance`: mean distance of the fingers while held, the pads' squeeze taken out [m];
- `rise`: mean height of the fingers over the place less that over the pickup, the pads' shear
  deflection taken out [m].

Means are Student-t weighted; their sampling variance is the sandwich estimate psi^2 / psi'^2
pooled over grips, with the integrated autocorrelation time of the residuals (Huber 1964; Sokal
1997; docs/properties.md). Each of the drawn alignments gives every sample to one subtask.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from estimation.channel_noise import Noise, channel_sds, learned
from estimation.compliance import Slope
from estimation.pad_slopes import slope_of_landing, slopes_within
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import block_width, block_y, inertia_factor, pads_of
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.levels import TAIL
from hmmseg.robust import robust_sd
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from hmmseg.segmentation.conformity import MAX_RATE
from hmmseg.segmentation.emissions import acceleration, thin
from hmmseg.tables import Brief

CHANNELS = ("force", "distance", "rise")
NUM_ALIGNMENTS = 16  # numerics: draws of all boundaries; their mean is known to a quarter of their sd
APART = 0.1  # chosen: s by which one finger touches or lets go after the other, at most
MIN_FREE = 8  # numerics: samples of free motion that tell the scale of the forces there


@dataclass(frozen=True, repr=False)
class Weights(Brief):
    """Sample weights (num_alignments, num_timesteps) of each grip's means in one trial.

    `grips[m]` maps "force", "distance", "pickup" and "place" to weights that sum to 1 over the
    samples (0 everywhere: nothing recorded), `counts[m]` to effective sample numbers
    (num_alignments,); `free` are weights (num_timesteps,) over free motion, `free_robust`
    (4, num_timesteps) those of each force, which a finger that touches early does not sway.
    `slopes[m]` maps "distance" and "rise" to slopes over the pads' give within the grip, and "landing" to
    that of heights from the touch to the place, where seen.
    """

    grips: dict[int, dict[str, np.ndarray]]
    counts: dict[int, dict[str, np.ndarray]]
    free: np.ndarray
    free_robust: np.ndarray
    free_count: float
    slopes: dict[int, dict[str, Slope]] = field(default_factory=dict)


def draw_boundaries(trial: TrialAlignment, rng: np.random.Generator, num: int) -> np.ndarray:
    """Boundary times (num, num_subtasks - 1) drawn from their posteriors, kept in order [s]."""
    columns = []
    for boundary in trial.boundaries:
        cumulative = np.cumsum(boundary.probabilities)
        columns.append(np.interp(rng.uniform(size=num) * cumulative[-1], cumulative, boundary.times))
    return np.maximum.accumulate(np.stack(columns, axis=1), axis=1)


def channel_values(signals: Signals, rig: Rig) -> dict[str, np.ndarray]:
    """The sample values behind each mean, arrays (num_timesteps,)."""
    s, pads = signals, pads_of(rig)
    width = block_width(s.distance, s.fx1, s.fx2, pads)
    height = block_y(s.y, s.fy1, s.fy2, pads)
    return {"force": s.fy, "distance": width, "pickup": height, "place": height}


def gravity_factor(signals: Signals, rig: Rig) -> np.ndarray:
    """1 + a / g (num_timesteps,): the net force of a carried block in units of its weight."""
    return inertia_factor(np.nan_to_num(acceleration(signals.t, signals.vy)), rig.gravity)


def subtask_masks(times: np.ndarray, boundaries: np.ndarray, num_subtasks: int) -> np.ndarray:
    """Booleans (num_alignments, num_subtasks, num_timesteps): which subtask each sample is in."""
    index = (times[None, :, None] >= boundaries[:, None, :]).sum(axis=2)
    return index[:, None, :] == np.arange(num_subtasks)[None, :, None]


def _members(steps: tuple[Subtask, ...], move: int) -> dict[str, list[int]]:
    """Subtask indices that each mean of a grip is taken over."""
    of_move = [s for s in steps if s.move == move]
    ground = [s.index for s in of_move if s.state == ON_GROUND]
    return {
        "force": [s.index for s in of_move if s.state == ABOVE_GROUND],
        "distance": [s.index for s in of_move if s.state != FREE],
        "pickup": ground[:1],
        "place": ground[1:],
    }


def held_as_described(present: np.ndarray, steps: tuple[Subtask, ...]) -> np.ndarray:
    """Of the subtasks that a recording shows (num_subtasks,), those of which its samples tell properties.

    A grip before a carry that never came held who knows what.
    """
    out = present.copy()
    for carry in steps:
        if carry.state == ABOVE_GROUND and not present[carry.index]:
            out[[s.index for s in steps if s.move == carry.move and s.state == ON_GROUND]] = False
    return out


def robust_weights(
    values: np.ndarray, mask: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Student-t weights (num_timesteps,), residuals and location of the masked values."""
    there = mask & np.isfinite(values)
    if not there.any():
        return np.zeros_like(values), np.full_like(values, np.nan), np.nan
    centre = float(np.median(values[there]))
    for _ in range(20):
        weight = (TAIL + 1) / (TAIL + ((values[there] - centre) / scale) ** 2)
        centre = float(weight @ values[there] / weight.sum())
    residual = values - centre
    weights = (TAIL + 1) / (TAIL + (residual / scale) ** 2)
    return np.where(np.isfinite(values), weights, 0.0), residual, centre


@dataclass(frozen=True, repr=False)
class WeighedTrial(Brief):
    """One trial thinned for estimation: signals, drawn alignments' masks and mean weights."""

    signals: Signals
    masks: np.ndarray
    weights: Weights


def aligned_weights(aligned: AlignedTrials, rng: np.random.Generator) -> tuple[list[WeighedTrial], Noise]:
    """Weights of every grip's means for drawn alignments, and the noise of each channel."""
    steps, rig = aligned.subtasks, aligned.rig
    prepared, felt, touches = [], [], []  # felt: what the fingers press with is measured
    for trial in aligned.trials:
        thinned = thin(trial.signals, MAX_RATE)
        medians = np.array([[b.quantile(0.5) for b in trial.boundaries]])
        drawn = draw_boundaries(trial, rng, NUM_ALIGNMENTS)
        best = subtask_masks(thinned.t, np.maximum.accumulate(medians, axis=1), len(steps))[0]
        present = held_as_described(trial.present, steps)
        masks = subtask_masks(thinned.t, drawn, len(steps)) & present[None, :, None]
        prepared.append((thinned, best & present[:, None], masks))
        felt.append("friction" not in trial.trial.hidden)
        touches.append([(boundary.mean, boundary.sd) for boundary in trial.boundaries])
    moves = sorted({s.move for s in steps if s.move is not None})
    landings = [(a, b) for a, b in pairwise(steps) if (a.state, b.state) == (ABOVE_GROUND, ON_GROUND)]
    touched = {b.move: a.index for a, b in landings}
    keys = ("force", "distance", "pickup", "place")
    scales = {key: _scale(prepared, steps, moves, key, rig) for key in keys}
    pooled: dict[str, list] = {key: [] for key in keys}
    out = []
    for (thinned, best, masks), squeezed, moments in zip(prepared, felt, touches, strict=True):
        values, factor = channel_values(thinned, rig), gravity_factor(thinned, rig)
        grips, counts = {}, {}
        for move in moves:
            grips[move], counts[move] = {}, {}
            for key, members in _members(steps, move).items():
                chosen = best[members].any(axis=0)
                v = values[key] / factor if key == "force" else values[key]
                weight, residual, _ = robust_weights(v, chosen, scales[key])
                pooled[key].append((residual[chosen], weight[chosen]))
                every = masks[:, members].any(axis=1) * weight
                total = every.sum(axis=1, keepdims=True)
                grips[move][key] = every / np.where(total > 0, total, 1.0)
                counts[move][key] = (masks[:, members].any(axis=1) & (weight > 0)).sum(axis=1)
        free = best[[s.index for s in steps if s.state == FREE]].any(axis=0)
        free &= np.isfinite(thinned.fx1 + thinned.fy1 + thinned.fx2 + thinned.fy2)
        # Beside a contact change one finger alone may touch, and the sample next to it be contact already.
        beside = 1 + int(np.ceil(APART / float(np.median(np.diff(thinned.t)))))
        free &= np.convolve(~free, np.ones(2 * beside + 1), "same") == 0
        robust = np.zeros((len(FORCE_CHANNELS), free.size))
        for row, name in zip(robust, FORCE_CHANNELS, strict=True):
            scale = _free_scale(thinned, name, free)
            weight, residual, _ = robust_weights(getattr(thinned, name), free, scale)
            row[:] = np.where(free, weight, 0.0) / max(weight[free].sum(), 1e-9)
            scales[name] = max(scales.get(name, 0.0), scale)
            pooled.setdefault(name, []).append((residual[free], weight[free]))
        slopes = {}
        for m in moves:
            members = _members(steps, m)
            groups = {k: np.asarray(best[i].any(axis=0)) for k, i in members.items() if k != "force"}
            slopes[m] = slopes_within(thinned, values, groups, scales, rig)
            if m in touched:
                k, place = touched[m], grips[m]["place"].mean(axis=0)
                net = values["force"] / factor
                slopes[m] |= slope_of_landing(thinned, values, net, best[k], place, moments[k], scales, rig)
        if not squeezed:
            slopes = {m: {k: v for k, v in of.items() if k != "distance"} for m, of in slopes.items()}
        weights = Weights(grips, counts, free / max(free.sum(), 1), robust, float(free.sum()), slopes)
        out.append(WeighedTrial(thinned, masks, weights))
    return out, learned(pooled, scales, channel_sds([p[0] for p in prepared], aligned))


def free_forces(signals: Signals, aligned: WeighedTrial) -> np.ndarray:
    """Mean forces (4,) in free motion [N], where they ought to vanish."""
    force = np.stack([getattr(signals, name) for name in FORCE_CHANNELS])
    return (aligned.weights.free_robust * np.nan_to_num(force)).sum(axis=1)


def _free_scale(signals: Signals, name: str, free: np.ndarray) -> float:
    """Robust scale of a force in free motion [N]; where there is next to none, what the rig states."""
    values = getattr(signals, name)[free]
    if values.size < MIN_FREE:
        return signals.sd_force if np.isfinite(signals.sd_force) else 1.0
    return max(robust_sd(values - np.median(values)), 1e-9)


def _scale(prepared: list, steps: tuple[Subtask, ...], moves: list[int], key: str, rig: Rig) -> float:
    """Robust scale of one channel's residuals, pooled over grips [unit of the channel]."""
    residuals = []
    for thinned, best, _ in prepared:
        v = channel_values(thinned, rig)[key]
        v = v / gravity_factor(thinned, rig) if key == "force" else v
        for move in moves:
            chosen = v[best[_members(steps, move)[key]].any(axis=0)]
            chosen = chosen[np.isfinite(chosen)]
            if chosen.size > 2:
                residuals.append(chosen - np.median(chosen))
    if not residuals:
        return 1.0
    return max(robust_sd(np.concatenate(residuals)), 1e-9)
