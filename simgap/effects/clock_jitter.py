"""Samples taken at irregular times."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import READOUT, Effect, Parameter, gradient, tips
from simgap.gap.trial_arrays import CHANNELS

JITTERS = np.geomspace(5e-4, 0.03, 40)  # prior: s


def _scatter(given, residual: np.ndarray):
    from simgap.gap.assemble import rows_of
    from simgap.gap.scatter import on_grid

    rows, rate = rows_of(given), _rates(given)[given.whitening.weight > 0]
    size = np.bincount(rows.cell, rate**2) / np.maximum(np.bincount(rows.cell), 1)
    part = rows.trial * len(rows.parts) + rows.part
    return on_grid("clock_jitter", residual**2, size[rows.cell], JITTERS, part)


def _rates(given) -> np.ndarray:
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
    return out * given.whitening.weight


EFFECT = Effect(
    name="clock_jitter",
    acts_on="sensing",
    says="true sample times = t + normal(0, sd)",
    shows="noise in proportion to the rate of change",
    mistaken_for=("noise",),
    called="samples that are not taken when their time stamps say",
    check="Log the acquisition clock beside the time stamps; look for samples stamped on arrival.",
    parameters=(Parameter("sd", "s", 1.0, neutral=0.004, log=True, low=1e-4, high=0.05),),
    stage=READOUT,
    sampled=lambda t, v, rng: t + rng.normal(0, v["sd"], t.size),
    scatter=_scatter,
    wrist=True,
)
