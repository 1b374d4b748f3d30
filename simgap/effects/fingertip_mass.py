"""Mass of a fingertip outboard of its force sensor."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import (
    HAND,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    gradient,
    tips,
    with_force,
    with_load,
)


def _correct(world: World, values, on) -> World:
    _, velocity = tips(world)
    up = jnp.stack([0.0 * world.gravity, world.gravity] * 2)[None, None, :]
    return with_load(world, values["mass"] * (gradient(world.t, velocity) + up))


def _apply(performance: Performance, values, rng) -> Performance:
    a = np.gradient(performance.velocity, performance.t, axis=0).reshape(-1, 4)
    return with_force(
        performance, flat(performance) + values["mass"] * (a + [0, performance.rig.gravity] * 2)
    )


EFFECT = Effect(
    name="fingertip_mass",
    acts_on="dynamics",
    says="recorded F = F + mass (a + g up), outboard of the sensor",
    shows="constant and inertial, free motion too",
    mistaken_for=("force_bias",),
    called="mass beyond the force sensor that the model lacks",
    check=(
        "Weigh what is mounted in front of the sensor, or hold the finger still at two heights and in two"
        " directions."
    ),
    parameters=(Parameter("mass", "kg", 0.012, low=0.0, high=0.1),),
    stage=HAND,
    correct=_correct,
    apply=_apply,
)
