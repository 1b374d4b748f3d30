"""Joints that turn within a dead band before the sensor follows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter, World
from simgap.effects.kinematics import moved_joints

RESTING = 0.02  # rad/s; slower joints keep their place in the dead band: sensors' noise moves nothing
LEAST = 2e-4  # rad; a narrower dead band is none


def side(world: World, width) -> jax.Array:
    """-1 to 1 (T, N, 4): where in the dead band each joint lies, driven by its own rate."""
    rates = world.rates
    padded = jnp.concatenate([rates[:, :1], rates, rates[:, -1:]], 1)
    smooth = (padded[:, :-2] + 2 * rates + padded[:, 2:]) / 4
    moving = jnp.sign(smooth) * jnp.maximum(jnp.abs(smooth) - RESTING, 0.0)
    step = jnp.median(world.t[:, 1:] - world.t[:, :-1])
    way = 2 * step * moving / jnp.maximum(width, LEAST)

    def follow(last, more):
        now = jnp.clip(last + more, -1.0, 1.0)
        return now, now

    _, sides = jax.lax.scan(follow, jnp.zeros_like(way[:, 0]), jnp.moveaxis(way, 1, 0))
    return jnp.moveaxis(sides, 0, 1)


def _correct(world: World, values, on) -> World:
    width = values["width"]
    return world._replace(joints=world.joints + 0.5 * width * side(world, width) * world.jointed)


def play(q: np.ndarray, width: float) -> np.ndarray:
    """The play operator over rows of q (n, 4): the output follows only outside the dead band."""
    out, last = np.empty_like(q), q[0].copy()
    for k, row in enumerate(q):
        last = np.clip(last, row - width / 2, row + width / 2)
        out[k] = last
    return out


EFFECT = Effect(
    name="backlash",
    acts_on="kinematics",
    says="recorded q follows q only outside a dead band of `width`",
    shows="position jumps where a joint reverses",
    mistaken_for=("fingertip_compliance",),
    parameters=(Parameter("width", "rad", 0.004, starts=(0.002, 0.006), low=0.0, high=0.05),),
    stage=KINEMATICS,
    correct=_correct,
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (play(q, v["width"]), dq)),
    coarse=True,
)
