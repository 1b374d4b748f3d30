"""Effects that spread samples instead of shifting them: irregular clocks and quantisation.

They leave the mean where it is, so the fit of properties stands and their evidence is that of a
variance (clock) or of a lattice (quantisation).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import gradient, tips
from simgap.gap.fit import Fitted, Problem, residual_at
from simgap.gap.frame import CHANNELS
from simgap.gap.locate import tamed

SPREADS = ("clock_jitter", "quantisation")
REPEATED = 0.5  # share of repeated values that only a lattice has
WRITTEN = 1e-5  # N; how finely forces are written that were not rounded before


@dataclass(frozen=True)
class Spread:
    """Evidence [nats] of a spread effect over none, its parameter and that parameter's log sd.

    `explained`: share of the excess square it accounts for, per trial and subtask energies `after`.
    """

    effect: str
    evidence: float
    value: float
    log_sd: float
    scale: np.ndarray


def clock(given: Problem, z: np.ndarray, samples: np.ndarray) -> Spread:
    """Variance of whitened residuals z (T, N, C) in proportion to the squared rate of change, on a grid of
    jitters [s]."""
    z = tamed(given, z)
    rate = _rates(given)
    there = (given.whitening.weight > 0) & (rate > 0)
    h2, z2 = rate[there] ** 2, z[there] ** 2

    def nats(sd: float) -> float:
        v = 1 + sd**2 * h2
        return float(0.5 * (z2 * (1 - 1 / v) - np.log(v)).sum())

    return _on_grid("clock_jitter", nats, samples, lambda sd: np.sqrt(1 + sd**2 * rate**2))


def _on_grid(name, nats, grid, scale) -> Spread:
    score = np.array([nats(float(v)) for v in grid])
    best = int(score.argmax())
    weight = np.exp(score - score.max())
    centre = np.average(np.log(grid), weights=weight)
    sd = max(float(np.sqrt(np.average((np.log(grid) - centre) ** 2, weights=weight))), 1e-3)
    evidence = float(score.max() + np.log(np.mean(weight)))  # uniform over the grid's logarithm
    return Spread(name, evidence, float(grid[best]), sd, scale(float(grid[best])))


def _rates(given: Problem) -> np.ndarray:
    """Whitened change per second of clock error (T, N, C): only where motion is fast."""
    w = given.frame.world
    world = jax.tree.map(jnp.asarray, w)
    _, velocity = tips(world)
    step = np.median(np.diff(w.t, axis=1))
    mean_v = np.asarray((velocity[..., :2] + velocity[..., 2:]) / 2)
    out = np.zeros_like(given.whitening.weight)
    # Central differences of positions read at wrong times: v times the times' difference over 2 steps; and
    # the mean (1, 4, 1) / 6 of speeds that were read at them.
    rate = np.asarray(gradient(world.t, jnp.asarray(mean_v)))
    for k, c in enumerate(("vx", "vy")):
        out[..., CHANNELS.index(c)] = np.hypot(mean_v[..., k] / step, rate[..., k]) / np.sqrt(2)
    # Errors of central differences two samples apart have no part in common with the sample before: the
    # whitening filter, made for noise that does, enlarges them.
    rho2 = given.whitening.carryover**2
    return out * given.whitening.weight * np.sqrt((1 + rho2) / (1 - rho2))


def quantised(given: Problem, z: np.ndarray) -> Spread:
    """Whether forces repeat the same values: levels of a lattice through zero.

    Written to 1e-5 N, as files are, one sample in ten repeats another's value by chance; on a lattice
    most do. The step is the usual gap between neighbouring levels, refined on all samples. Values that
    were not rounded would all fall on levels so far apart with a chance of WRITTEN / step each; and what
    rounding adds to the noise explains of what a fit leaves, `z` (T, N, C).
    """
    frame = given.frame
    force = frame.world.force[: frame.num_trials]
    values = np.concatenate([force[r, :n].ravel() for r, n in enumerate(frame.lengths)])
    levels = np.unique(np.round(np.abs(values), 6))
    repeated = 1 - levels.size / values.size
    plain = np.ones_like(given.whitening.weight)
    if repeated < REPEATED or levels.size < 4:
        return Spread("quantisation", -10.0, 0.05, 1.0, plain)
    step = float(np.median(np.diff(levels)))
    for reach in (4, 16, 64, 256):  # farther levels tell the step ever more closely
        count = np.round(values / step)
        near = (np.abs(count) <= reach) & (count != 0)
        if near.any():
            step = float(values[near] @ count[near] / (count[near] @ count[near]))
    off = np.abs(values / step - np.round(values / step))
    if np.mean(off < 0.1) < 0.9:
        return Spread("quantisation", -10.0, step, 1.0, plain)
    parts = {"fx": 2.0, "fy": 2.0, "grip": 0.5, "shear": 0.5}
    scale = plain.copy()
    for channel, share in parts.items():
        c = CHANNELS.index(channel)
        scale[..., c] = np.sqrt(1 + share * step**2 / 12 * given.whitening.weight[..., c] ** 2)
    lattice = values.size * np.log(step / WRITTEN)
    noise = (0.5 * z**2 * (1 - scale**-2) - np.log(scale)).sum()
    return Spread("quantisation", float(lattice + noise), step, 1e-3, scale)


def spreads(given: Problem, fitted: Fitted) -> list[Spread]:
    """Both spread effects, tried on top of a fit."""
    z = residual_at(given, fitted.effects, fitted.u)
    return [clock(given, z, np.geomspace(5e-4, 0.03, 40)), quantised(given, z)]
