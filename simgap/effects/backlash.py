"""Joints that turn within a dead band before the sensor follows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter, World, gradient
from simgap.effects.kinematics import moved_joints

HUSH = 3.0  # chosen: sds of an angle by which it must turn on before its joint is taken to move
CROSSED, STAYED = 0.6, 0.1  # chosen: variance midway through a rest of a joint that turns back, or goes on


def _moves(joints: jax.Array) -> jax.Array:
    """Direction (T, N, 4) in which each recorded angle moves: -1, 1, or 0 where it rests."""
    bend = jnp.abs(joints[:, 2:] - 2 * joints[:, 1:-1] + joints[:, :-2])
    hush = HUSH * jnp.maximum(jnp.median(bend, axis=1) / (0.6745 * np.sqrt(6)), 1e-6)

    def follow(last, now):
        new = jnp.clip(last, now - hush, now + hush)
        return new, jnp.sign(new - last)

    _, out = jax.lax.scan(follow, joints[:, 0], jnp.moveaxis(joints, 1, 0))
    return jnp.moveaxis(out, 0, 1)


def _nearest(moves: jax.Array, reverse: bool) -> tuple[jax.Array, jax.Array]:
    """The last move before each sample (the next one in reverse), 0 where there is none, and how long ago.

    A sample's own noise would choose its own side, so its own move does not count.
    """

    def keep(state, now):
        move, ago = state
        after = jnp.where(now != 0, now, move), jnp.where(now != 0, 1.0, ago + 1)
        return after, state

    start = jnp.zeros_like(moves[:, 0]), jnp.ones_like(moves[:, 0])
    _, (move, ago) = jax.lax.scan(keep, start, jnp.moveaxis(moves, 1, 0), reverse=reverse)
    return jnp.moveaxis(move, 0, 1), jnp.moveaxis(ago, 0, 1)


def side(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where in the dead band each joint lies (T, N, 4), -1 to 1: its mean and its variance.

    A recorded angle that moves pins its joint to the side it moves to. At rest the joint goes from one pin
    to the next, no one knows when.
    """
    moves = _moves(joints)
    (last, ago), (following, ahead) = _nearest(moves, False), _nearest(moves, True)
    rest = ago + ahead - 1
    share = (ago - 0.5) / rest
    share = jnp.where(last == 0, 1.0, jnp.where(following == 0, 0.0, share))
    midway = jnp.where(last == following, STAYED * (1 - 1 / rest), CROSSED)
    open_end = (last == 0) | (following == 0)
    variance = jnp.where(open_end, STAYED, 4 * share * (1 - share) * midway)
    return last * (1 - share) + following * share, variance


def _correct(world: World, values, on) -> World:
    place, variance = side(world.joints)
    half = 0.5 * values["width"] * world.jointed
    hidden = half * gradient(world.t, place)
    return world._replace(
        joints=world.joints + half * place,
        rates=world.rates + values["unseen"] * hidden,
        doubt_joints=world.doubt_joints + half**2 * variance,
    )


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
    called="play in the joints",
    check="Hold each motor still and move its fingertip by hand; look for slack in gears or cables.",
    parameters=(
        Parameter("width", "rad", 0.004, starts=(0.002, 0.006), low=0.0, high=0.05),
        # Rates from the encoder miss what it misses (1); a tachometer's do not (0).
        Parameter("unseen", "1", 0.5, neutral=0.5, low=0.0, high=1.0, hidden=True),
    ),
    stage=KINEMATICS,
    correct=_correct,
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (play(q, v["width"]), dq)),
)
