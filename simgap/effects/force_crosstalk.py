"""Each force axis picks up a share of the other one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import MIX, Effect, Parameter, Performance, World, flat, with_force


def mixed(force, matrix, xp):
    """Forces (..., 4) with both fingers' (x, y) pairs multiplied by a 2 x 2 matrix of scalars."""
    (a, b), (c, d) = matrix
    fx1, fy1, fx2, fy2 = (force[..., k] for k in range(4))
    return xp.stack([a * fx1 + b * fy1, c * fx1 + d * fy1, a * fx2 + b * fy2, c * fx2 + d * fy2], -1)


def _correct(world: World, values, on) -> World:
    e, h = values["fy_from_fx"], values["fx_from_fy"]
    scale = 1 / (1 - e * h)
    force = mixed(world.force, ((scale, -h * scale), (-e * scale, scale)), jnp)
    # Of net fx, net fy, grip and shear: each has the noise of both axes.
    quiet = jnp.stack([1 / jnp.sqrt(1 + h**2), 1 / jnp.sqrt(1 + e**2)] * 2) / scale
    return world._replace(force=force, loudness=world.loudness * quiet[None, None, :])


def _apply(performance: Performance, values, rng) -> Performance:
    matrix = ((1.0, values["fx_from_fy"]), (values["fy_from_fx"], 1.0))
    return with_force(performance, mixed(flat(performance), matrix, np))


EFFECT = Effect(
    name="force_crosstalk",
    acts_on="sensing",
    says="recorded fy = fy + e fx and fx = fx + h fy",
    shows="shear and net force follow the grip",
    mistaken_for=("sensor_rotation",),
    called="cross-talk between the axes of a force sensor",
    check=(
        "Press straight against a wall with one finger and see whether the other axis moves; redo the "
        "calibration matrix."
    ),
    parameters=(
        Parameter("fy_from_fx", "1", 0.06, low=-0.2, high=0.2),
        Parameter("fx_from_fy", "1", 0.06, low=-0.2, high=0.2),
    ),
    stage=MIX,
    correct=_correct,
    apply=_apply,
)
