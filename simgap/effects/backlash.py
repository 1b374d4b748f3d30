"""Joints that turn within a dead band before the sensor follows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter, World, gradient
from simgap.effects.kinematics import moved_joints

HUSH = 3.0  # chosen: sds of an angle by which it must turn on before its joint is taken to move
CROSSED, STAYED = 0.6, 0.1  # chosen: variance midway through a rest of a joint that turns back, or goes on


def _noise(values: jax.Array) -> jax.Array:
    """Noise (T, 4) of sampled signals (T, N, 4), from their second differences."""
    bend = jnp.abs(values[:, 2:] - 2 * values[:, 1:-1] + values[:, :-2])
    return jnp.maximum(jnp.median(bend, axis=1) / (0.6745 * np.sqrt(6)), 1e-6)


def _moves(joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Direction (T, N, 4) in which each recorded angle moves, -1, 1, or 0 where it rests; and the angle
    without its noise: it stays where it rests."""
    hush = HUSH * _noise(joints)

    def follow(last, now):
        new = jnp.clip(last, now - hush, now + hush)
        return new, (jnp.sign(new - last), new)

    _, out = jax.lax.scan(follow, joints[:, 0], jnp.moveaxis(joints, 1, 0))
    return jnp.moveaxis(out[0], 0, 1), jnp.moveaxis(out[1], 0, 1)


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


def within(world: World, half: jax.Array, unseen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where in the dead band of so much to either side [rad] each joint lies (T, N, 4): mean and variance.

    A recorded angle that moves pins its joint to the side it moves to. At rest the joint goes from one pin
    to the next: as its speed says, unless that is `unseen`; then no one knows when. A band narrower than what
    an angle must turn on by to be seen moving is not seen either.
    """
    half = half * jnp.clip(2 * half / (HUSH * _noise(world.joints)[:, None]) - 1, 0.0, 1.0)
    moves, calm = _moves(world.joints)
    (last, ago), (following, ahead) = _nearest(moves, False), _nearest(moves, True)
    rest = ago + ahead - 1
    share = (ago - 0.5) / rest
    share = jnp.where(last == 0, 1.0, jnp.where(following == 0, 0.0, share))
    midway = jnp.where(last == following, STAYED * (1 - 1 / rest), CROSSED)
    open_end = (last == 0) | (following == 0)
    blind = jnp.square(half) * jnp.where(open_end, STAYED, 4 * share * (1 - share) * midway)

    # Speeds integrated less what the sensor saw: how far the joint went in its dead band, but for a constant.
    step = (world.t[:, 1:] - world.t[:, :-1])[..., None]
    went = jnp.cumsum(step * (world.rates[:, 1:] + world.rates[:, :-1]) / 2, axis=1)
    went = jnp.pad(went, ((0, 0), (1, 0), (0, 0)))
    hidden = went - calm
    # Of a sample that moves, what the sensor saw before: its own noise must not be taken out of it.
    own = went - jnp.concatenate([calm[:, :1], calm[:, :-1]], axis=1)
    n = hidden.shape[1]
    here = jnp.arange(n)[None, :, None]
    before, after = (
        jnp.take_along_axis(hidden, jnp.clip(here + k.astype(int), 0, n - 1), axis=1) for k in (-ago, ahead)
    )
    pinned = half * (last * (1 - share) + following * share)
    free = (moves == 0) | (last != following)
    path = pinned + (1 - unseen) * jnp.where(free, own - before * (1 - share) - after * share, 0.0)
    walk = jnp.square(_noise(world.rates)[:, None] * jnp.median(step))
    length = jnp.where(open_end, jnp.minimum(ago, ahead), rest * share * (1 - share))
    seen = jnp.minimum(walk * length, blind)
    return jnp.clip(path, -half, half), unseen * blind + (1 - unseen) * seen


def _correct(world: World, values, on) -> World:
    half, unseen = 0.5 * values["width"] * world.jointed, values["unseen"]
    place, variance = within(world, half, unseen)
    return world._replace(
        joints=world.joints + place,
        rates=world.rates + unseen * gradient(world.t, place),
        doubt_joints=world.doubt_joints + variance,
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
        Parameter("unseen", "1", 0.5, starts=(0.8,), low=0.0, high=1.0, hidden=True),
    ),
    forms=(("width",), ("width", "unseen")),
    stage=KINEMATICS,
    correct=_correct,
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (play(q, v["width"]), dq)),
)
