"""Friction of a block on its support, from the net force while it is slid along.

Newton's and Coulomb's laws for a block of weight W pushed in direction d = +-1:

    d fx = mu (W - fy) + d a W / g,

fx and fy the net forces of the fingers, a the horizontal acceleration. At varying fy the line's
slope tells mu and its intercept W; a carry of the same block tells W besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.observations import WeighedTrial, gravity_factor
from hmmseg.contact.decompose import ABOVE_GROUND, SLIDING, Subtask
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.emissions import acceleration

MOVING = 3.0  # chosen: noise sds of the velocity beyond which the block surely slides
FEWEST = 4  # numerics: samples of sliding
WIDEST = 0.3  # chosen: relative sd beyond which the load varied too little to tell
COEFFICIENTS = np.geomspace(0.01, 3.0, 400)  # prior: evenly in their logarithm; solids slide on solids within


@dataclass(frozen=True)
class GroundFriction:
    """Posterior draws (num_draws,) of the friction coefficient against `support` ("ground" or a block)."""

    support: str
    mu_draws: np.ndarray


def ground_friction(
    weighed: Sequence[WeighedTrial], task: BlockTask, steps: tuple[Subtask, ...], obj: str, rig: Rig,
    sd_force: float, rng: np.random.Generator, num_draws: int,
) -> GroundFriction | None:  # fmt: skip
    """Friction of a block on what it is slid on; None where it is not, or where that tells too little.

    The last support counts where a task slides the block on several.
    """
    slid = [s for s in steps if s.object == obj and s.state == SLIDING and s.move is not None]
    if not slid:
        return None
    support = task.performed[slid[-1].move or 0].to
    rows = [_rows(a, s, rig) for a in weighed for s in slid if task.performed[s.move or 0].to == support]
    table = np.concatenate(rows)
    if len(table) < FEWEST:
        return None
    stated = weighed[0].signals.sd_force
    noise = 2 * (stated if np.isfinite(stated) else sd_force) ** 2
    log_posterior = _log_posterior(table, noise, _carried(weighed, steps, obj, rig, noise))
    probability = np.exp(log_posterior - log_posterior.max())
    cdf = np.cumsum(probability * np.gradient(COEFFICIENTS))
    draws = np.interp(rng.uniform(size=num_draws) * cdf[-1], cdf, COEFFICIENTS)
    return GroundFriction(support, draws) if draws.std() < WIDEST * draws.mean() else None


def _rows(a: WeighedTrial, step: Subtask, rig: Rig) -> np.ndarray:
    """Rows (num_samples, 3) of d fx [N], d a / g and fy [N] while the block surely slides."""
    s, free = a.signals, a.weights.free
    sliding = a.masks[:, step.index].all(axis=0) & np.isfinite(s.fx + s.fy + s.vx)
    if not sliding.any():
        return np.zeros((0, 3))
    direction = np.sign(np.median(s.vx[sliding]))
    sd = np.where(np.isfinite(s.sd_vx), s.sd_vx, 0.0) / np.sqrt(2.0)
    sliding &= direction * np.nan_to_num(s.vx) > MOVING * sd
    bias_x, bias_y = (float(free @ np.nan_to_num(f)) for f in (s.fx, s.fy))
    lag = direction * np.nan_to_num(acceleration(s.t, s.vx)) / rig.gravity
    return np.stack([direction * (s.fx - bias_x), lag, s.fy - bias_y], axis=1)[sliding]


def _carried(
    weighed: Sequence[WeighedTrial], steps: tuple[Subtask, ...], obj: str, rig: Rig, noise: float
) -> tuple[float, float] | None:
    """Weight and its sd [N] as carries of the same block tell it; None where it is not carried."""
    moves = [s.move for s in steps if s.object == obj and s.state == ABOVE_GROUND and s.move is not None]
    means, counts = [], []
    for a in weighed:
        factor, s = gravity_factor(a.signals, rig), a.signals
        bias = float(a.weights.free @ np.nan_to_num(s.fy))
        for move in moves:
            weight, count = a.weights.grips[move]["force"].mean(axis=0), a.weights.counts[move]["force"]
            if count.min() > 0:
                means.append(float(weight @ np.nan_to_num(s.fy - bias) / (weight @ factor)))
                counts.append(float(count.mean()))
    if not means:
        return None
    total = float(np.sum(counts))
    return float(np.dot(means, counts) / total), float(np.sqrt(noise / total)) + 0.005 * abs(means[0])


def _log_posterior(table: np.ndarray, noise: float, carried: tuple[float, float] | None) -> np.ndarray:
    """Log density (num_coefficients,) of the law with noise in both net forces, weight marginalised.

    For a given mu the law is linear in W: d fx + mu fy = W (mu + d a / g). The prior of W is
    Gaussian as `carried` has it, otherwise flat in its logarithm.
    """
    left = table[:, 0] + COEFFICIENTS[:, None] * table[:, 2]
    right = COEFFICIENTS[:, None] + table[:, 1]
    variance = noise * (1 + COEFFICIENTS**2)
    mean, precision = (0.0, 0.0) if carried is None else (carried[0], carried[1] ** -2)

    def fitted(inflated: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        information = (right**2).sum(axis=1) / inflated + precision
        weight = ((left * right).sum(axis=1) / inflated + mean * precision) / information
        square = ((left - weight[:, None] * right) ** 2).sum(axis=1) / inflated
        return square + precision * (weight - mean) ** 2, weight, information

    excess = max(float(fitted(variance)[0].min()) / max(len(table) - 2, 1), 1.0)
    square, weight, information = fitted(variance * excess)
    out = -0.5 * (square + len(table) * np.log(variance) + np.log(information))
    flat = np.log(np.maximum(weight, 1e-6)) if carried is None else 0.0
    return np.where(weight > 0, out - flat, -np.inf)
