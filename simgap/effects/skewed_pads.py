"""Fingertips that give way sideways when they are pressed: their compliance has no axis along the grip."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter, Performance, World, per_channel, swung

GIVES = ("give1", "give2")


def _correct(world: World, values, on) -> World:
    rise = per_channel(values, GIVES) * jnp.abs(world.force[..., 0::2])
    along_x, along_y = swung(world)
    inner, outer = along_x[..., 0::2], along_x[..., 1::2]
    turn = rise / (inner * along_y[..., 1::2] - outer * along_y[..., 0::2])
    joints = jnp.stack([-outer * turn, inner * turn], -1).reshape(world.joints.shape)
    place = jnp.stack([jnp.zeros_like(rise), rise], -1).reshape(world.joints.shape)
    return world._replace(joints=world.joints - jnp.where(world.jointed > 0.5, joints, place))


def _apply(performance: Performance, values, rng) -> Performance:
    rise = np.abs(performance.force[:, :, 0]) * [values[n] for n in GIVES]
    rate = np.gradient(rise, performance.t, axis=0)
    position, velocity = performance.position.copy(), performance.velocity.copy()
    position[:, :, 1] += rise
    velocity[:, :, 1] += rate
    return performance._replace(position=position, velocity=velocity)


DECOY = Effect(
    name="skewed_pads",
    acts_on="contact",
    says="fingertips rise by give times the grip force, each by its own",
    shows="offset and y while held, in proportion to the grip",
    mistaken_for=("force_crosstalk", "fingertip_compliance"),
    parameters=tuple(Parameter(n, "m/N", 1e-4) for n in GIVES),
    stage=KINEMATICS,
    correct=_correct,
    apply=_apply,
)
