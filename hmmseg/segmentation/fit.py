"""Maximum likelihood of the contact emissions within the task's forced order, by EM.

No threshold is left to the user: grip forces are split into two groups by Otsu's criterion for a start, and
EM (expectation over alignments, robust weighted updates) does the rest. Trials of one task are pooled: they
share weights, biases and scales, but not resting levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask
from hmmseg.hmm import Chain, em
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.levels import TAIL
from hmmseg.robust import NORMAL, coarse_step, weighted_median
from hmmseg.segmentation.emissions import LEAST_SCALE, Features, Parameters, log_likelihoods
from hmmseg.tables import Brief


@dataclass(frozen=True, repr=False)
class Fit(Brief):
    """Fitted emissions and the alignment posterior of every trial."""

    parameters: Parameters
    posteriors: tuple[AlignmentPosterior, ...]


def otsu(values: np.ndarray) -> float:
    """Threshold between two groups of largest between-group variance (Otsu 1979)."""
    v = np.sort(values[np.isfinite(values)])
    n = np.arange(1, v.size)
    cumulative = np.cumsum(v)[:-1]
    low, high = cumulative / n, (v.sum() - cumulative) / (v.size - n)
    best = int(np.argmax(n * (v.size - n) * (high - low) ** 2))
    return float((v[best] + v[best + 1]) / 2)


def initial_parameters(features: Sequence[Features], subtasks: tuple[Subtask, ...]) -> Parameters:
    """Rough initial parameters: biases from ungripped samples, one weight from gripped, moving ones."""
    force = np.concatenate([f.force for f in features])
    grip = np.concatenate([f.grip for f in features])
    speed = np.concatenate([np.hypot(f.vx, f.vy) for f in features])
    held = grip > otsu(grip)
    free = force[~held]
    bias = np.nan_to_num(np.nanmedian(free, axis=0))
    noise = float(np.nanmedian(NORMAL * np.nanmedian(np.abs(free - bias), axis=0)))
    noise = max(noise, _least_force(features))
    fy = force[:, 1] + force[:, 3] - bias[1] - bias[3]
    known = held & np.isfinite(speed)
    moving = known & (speed > np.median(speed[known])) if known.any() else held
    lifted = fy[moving & np.isfinite(fy)]
    span = max(f.span["force"] for f in features)
    weight = max(float(np.median(lifted)) if lifted.size else 0.0, 3 * noise, 0.01 * span)
    names = [str(s.object) for s in subtasks if s.state != FREE]  # in order: sums round differently otherwise
    scale = {
        "force": noise, "carry": 0.3 * weight, "net_x": 0.1 * span, "shear": 0.1 * span,
        "velocity": 0.01, "level": 1e-3, "width": 1e-3,
    }  # fmt: skip
    return Parameters(bias, dict.fromkeys(names, weight), scale)


def _least_force(features: Sequence[Features]) -> float:
    """Least noise [N] of a force: what rounding to steps adds, in the median trial."""
    steps = [max(coarse_step(force) for force in f.force.T) for f in features]
    return max(float(np.median(steps)) / np.sqrt(12), 1e-6)


def chain_of(shares: np.ndarray, length: int) -> Chain:
    """Chain of geometric durations whose means are these shares (num_subtasks,) of a trial's samples."""
    advance = np.clip(1.0 / np.maximum(shares * length, 1.5), 1e-6, 0.6)
    return Chain(np.log1p(-advance), np.log(advance[:-1]))


def mean_shares(gammas: Sequence[np.ndarray]) -> np.ndarray:
    """Posterior mean shares (num_subtasks,) of time spent in each subtask, given state probabilities.

    The prior is a symmetric Dirichlet distribution worth one trial.
    """
    counts = np.sum([g.mean(axis=0) for g in gammas], axis=0)
    return (counts + 1.0 / counts.size) / (counts.sum() + 1.0)


Model = tuple[Parameters, np.ndarray]  # of the emissions, and the subtasks' shares (S,) of a trial's time


def fit(features: Sequence[Features], subtasks: tuple[Subtask, ...], start: Parameters | None = None) -> Fit:
    """Fit emissions and durations to the given trials, pooled, within the forced order.

    Args:
        features: of each trial.
        subtasks: in order.
        start: initial parameters; those of `initial_parameters` by default.

    Raises:
        InfeasibleAlignment: a trial is too short for its subtasks.
    """

    def tables(model: Model) -> tuple[list[np.ndarray], list[Chain]]:
        parameters, shares = model
        lls = [log_likelihoods(f, subtasks, parameters, i) for i, f in enumerate(features)]
        return lls, [chain_of(shares, f.t.size) for f in features]

    def updated(model: Model, gammas: Sequence[np.ndarray]) -> Model:
        return maximisation(features, subtasks, model[0], gammas), mean_shares(gammas)

    equal = np.full(len(subtasks), 1.0 / len(subtasks))
    learned = em((start or initial_parameters(features, subtasks), equal), tables, updated)
    return Fit(learned.model[0], learned.alignments)


def maximisation(features: Sequence[Features], subtasks: tuple[Subtask, ...],
                 old: Parameters, gammas: Sequence[np.ndarray]) -> Parameters:  # fmt: skip
    """Update every parameter by its expected weighted Student-t likelihood (ECM)."""
    force = np.concatenate([f.force for f in features])
    states = np.array([s.state for s in subtasks])
    every = np.concatenate(gammas)
    free = every[:, states == FREE].sum(axis=1)
    above = every[:, states == ABOVE_GROUND].sum(axis=1)
    ground = every[:, np.isin(states, (ON_GROUND, SLIDING))].sum(axis=1)
    noise = old.scale["force"]
    bias = np.array([_location(force[:, c], free, noise, old.bias[c]) for c in range(4)])
    unbiased = force - bias
    fy, net_x = unbiased[:, 1] + unbiased[:, 3], unbiased[:, 0] + unbiased[:, 2]
    shear = (unbiased[:, 1] - unbiased[:, 3]) / 2
    factor = np.concatenate([f.carrying for f in features])
    weight, residual = dict(old.weight), np.full(fy.size, np.nan)
    for name in weight:
        columns = [i for i, s in enumerate(subtasks) if s.object == name and s.state == ABOVE_GROUND]
        gamma = every[:, columns].sum(axis=1)
        if gamma.sum() > 1:
            weight[name] = max(_location(fy / factor, gamma, old.scale["carry"], old.weight[name]), 1e-3)
            residual = np.where(gamma > 0.5, fy - weight[name] * factor, residual)
    scale = {
        "force": _scale(unbiased.ravel(), np.repeat(free, 4), noise, _least_force(features)),
        "carry": _scale(residual, above, old.scale["carry"], noise),
        "net_x": _scale(net_x, above + ground, old.scale["net_x"], noise),
        "shear": _scale(shear, above + ground, old.scale["shear"], noise),
    }
    scale["velocity"], scale["level"], levels = _rest(features, subtasks, old, bias, gammas)
    width, scale["width"] = _widths(features, subtasks, old, bias, every)
    return Parameters(bias, weight, scale, width, levels)


def _widths(features: Sequence[Features], subtasks: tuple[Subtask, ...], old: Parameters,
            bias: np.ndarray, every: np.ndarray) -> tuple[dict[str, float], float]:  # fmt: skip
    """Width per held object, from the fingers' distance without the pads' squeeze, and its scale."""
    unsqueezed = np.concatenate([f.block_width(bias) for f in features])
    spread = float(np.hypot(features[0].usual["d"], old.scale["width"]))
    width, residuals, weights = {}, [], []
    for name in old.weight:
        held = [i for i, s in enumerate(subtasks) if s.object == name and s.state != FREE]
        gamma = every[:, held].sum(axis=1)
        if not (np.isfinite(unsqueezed) & (gamma > 0)).any():
            continue  # never held at a known distance
        start = old.width.get(name) or weighted_median(unsqueezed, gamma)
        width[name] = _location(unsqueezed, gamma, spread, start)
        residuals.append(unsqueezed - width[name])
        weights.append(gamma)
    least = LEAST_SCALE * features[0].usual["d"]
    if not width:
        return width, old.scale["width"]
    residual, weight = np.concatenate(residuals), np.concatenate(weights)
    return width, _scale(residual, weight, max(old.scale["width"], least), least)


def _rest(
    features: Sequence[Features], subtasks: tuple[Subtask, ...], old: Parameters, bias: np.ndarray,
    gammas: Sequence[np.ndarray],
) -> tuple[float, float, tuple[dict[int, float], ...]]:  # fmt: skip
    """Velocity scale, level scale and resting levels of the holds on the ground."""
    velocity, level, weights, levels = [], [], [], []
    columns = [s.index for s in subtasks if s.state in (ON_GROUND, SLIDING)]
    for i, (f, gamma) in enumerate(zip(features, gammas, strict=True)):
        resting = f.block_y(bias)
        own = {}
        for k in columns:
            spread = np.hypot(f.usual["y"], old.scale["level"])
            if not (np.isfinite(resting) & (gamma[:, k] > 0)).any():
                continue  # never at rest at a known height
            start = old.levels[i].get(k) if old.levels else None
            start = weighted_median(resting, gamma[:, k]) if start is None else start
            own[k] = _location(resting, gamma[:, k], spread, start)
            velocity.append(f.vy)
            level.append(resting - own[k])
            weights.append(gamma[:, k])
        levels.append(own)
    if not weights:
        return old.scale["velocity"], old.scale["level"], tuple(levels)
    gamma = np.concatenate(weights)
    least_v = LEAST_SCALE * float(np.median(np.concatenate([f.sd_vy for f in features])))
    least_y = LEAST_SCALE * float(np.median(np.concatenate([f.sd_y for f in features])))
    return (
        _scale(np.concatenate(velocity), gamma, max(old.scale["velocity"], least_v), least_v),
        _scale(np.concatenate(level), gamma, max(old.scale["level"], least_y), least_y),
        tuple(levels),
    )


def _location(values: np.ndarray, weights: np.ndarray, scale: float, start: float) -> float:
    """Weighted Student-t location by iterative reweighting, from `start`."""
    keep = np.isfinite(values)
    v, w, centre = values[keep], weights[keep], start
    if w.sum() < 1e-6:
        return start
    for _ in range(5):
        robust = w * (TAIL + 1) / (TAIL + ((v - centre) / scale) ** 2)
        centre = float(robust @ v / robust.sum())
    return centre


def _scale(residual: np.ndarray, weights: np.ndarray, start: float, least: float) -> float:
    """Weighted Student-t scale by iterative reweighting, weakly shrunk towards `start`."""
    keep = np.isfinite(residual)
    r2, w, variance = residual[keep] ** 2, weights[keep], start**2
    if w.sum() < 1e-6:
        return start
    for _ in range(5):
        robust = w * (TAIL + 1) / (TAIL + r2 / variance)
        variance = float((robust @ r2 + variance) / (w.sum() + 1))
    return max(float(np.sqrt(variance)), least)
