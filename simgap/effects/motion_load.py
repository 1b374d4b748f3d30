"""A force on both fingers that is any linear function of where they are and how they move."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
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
from simgap.effects.cable_force import MIDDLE

USUAL = (0.03, 0.1, 0.5)  # prior: m, m/s, m/s^2: what they work with
MOTIONS = ("x", "y", "vx", "vy", "ax", "ay")
NAMES = tuple(f"{axis}_of_{motion}" for axis in ("fx", "fy") for motion in MOTIONS)


def _load(position, velocity, acceleration, values, xp):
    """Forces (..., 4) [N] of motions (..., 4)."""
    steady = xp.stack([xp.asarray(values[n], float) for n in FORCE_CHANNELS])
    matrix = xp.stack([xp.asarray(values[n], float) for n in NAMES]).reshape(2, 6)
    out = []
    for finger in (0, 1):
        mine = slice(2 * finger, 2 * finger + 2)
        place = xp.stack([position[..., 2 * finger + k] - MIDDLE[k] for k in (0, 1)], -1)
        parts = (place, velocity[..., mine], acceleration[..., mine])
        motion = xp.concatenate([part / usual for part, usual in zip(parts, USUAL, strict=True)], -1)
        out.append(motion @ matrix.T)
    out = xp.concatenate(out, -1)
    return out + xp.broadcast_to(steady, out.shape)


def _correct(world: World, values, on) -> World:
    position, velocity = tips(world)
    return with_load(world, _load(position, velocity, gradient(world.t, velocity), values, jnp))


def _apply(performance: Performance, values, rng) -> Performance:
    acceleration = np.gradient(performance.velocity, performance.t, axis=0)
    position, velocity = performance.position.reshape(-1, 4), performance.velocity.reshape(-1, 4)
    load = _load(position, velocity, acceleration.reshape(-1, 4), values, np)
    return with_force(performance, flat(performance) + load)


DECOY = Effect(
    name="motion_load",
    acts_on="dynamics",
    says="a force on both fingers, linear in position, velocity and acceleration",
    shows="free motion too",
    mistaken_for=("cable_force", "viscous_drag", "fingertip_mass", "force_bias"),
    parameters=tuple(Parameter(n, "N", 0.05) for n in (*FORCE_CHANNELS, *NAMES)),
    stage=HAND,
    correct=_correct,
    apply=_apply,
)
