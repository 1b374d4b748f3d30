"""Every force channel picks up a share of every other one, of the other finger's sensor too."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import MIX, Effect, Parameter, Performance, World, flat, with_force

NAMES = tuple(f"{to}_from_{of}" for to in FORCE_CHANNELS for of in FORCE_CHANNELS)
# physics: net, grip, shear
NET = np.array([[1.0, 0, 1, 0], [0, 1, 0, 1], [0.5, 0, -0.5, 0], [0, 0.5, 0, -0.5]])


def _correct(world: World, values, on) -> World:
    whole = jnp.eye(4) + jnp.stack([jnp.asarray(values[n], float) for n in NAMES]).reshape(4, 4)
    noise = jnp.sqrt(jnp.square(NET @ whole).sum(1) / jnp.square(NET).sum(1))
    return world._replace(force=world.force @ whole.T, loudness=world.loudness / noise[None, None, :])


def _apply(performance: Performance, values, rng) -> Performance:
    whole = np.eye(4) + np.array([values[n] for n in NAMES]).reshape(4, 4)
    return with_force(performance, flat(performance) @ np.linalg.inv(whole).T)


DECOY = Effect(
    name="force_mixing",
    acts_on="sensing",
    says="F = (1 + M) recorded F, M any matrix of both fingers' four channels",
    shows="every load, in every channel",
    mistaken_for=("force_crosstalk", "sensor_rotation"),
    parameters=tuple(Parameter(n, "1", 0.06, low=-0.3, high=0.3) for n in NAMES),
    stage=MIX,
    correct=_correct,
    apply=_apply,
)
