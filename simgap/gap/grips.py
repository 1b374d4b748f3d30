"""Grips: how firmly they hold, and values less what stays the same while one holds."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from simgap.effects.base import SLIDING, World
from simgap.gap.frame import Arrays
from simgap.gap.trial_arrays import CHANNELS

HELD = 0.1  # chosen: N; a grip below this holds nothing,
# chosen: nor one below this share of its usual force: pads that let go slide by what shears they bear
LOOSE = 0.35
USUAL = 11.0  # numerics: logit of the weight of a grip of the usual force
SLIDE = 2e-3  # prior: m; how far a pad may slide from one sample to the next
ANYWHERE = 0.05  # prior: m; sd of where a grip takes its block


def firmness(grip: jax.Array, held: jax.Array, moves: jax.Array, loose: float = LOOSE) -> jax.Array:
    """How surely (T, N) a grip's pads hold the block rather than slide on it as they close or let go."""
    mine = moves * held[..., None]
    usual = jnp.einsum("tnm,tn->tm", mine, grip) / jnp.maximum(mine.sum(1), 1.0)
    least = jnp.maximum(HELD, loose * jnp.einsum("tnm,tm->tn", moves, usual))
    return jax.nn.sigmoid((grip / least - 1) * USUAL / (1 / loose - 1))


def recorded(arrays: Arrays, channel: str) -> jax.Array:
    """Where (T, N) a channel's residual is defined and its signals were recorded."""
    return jnp.asarray(arrays.there[..., CHANNELS.index(channel)])


def less_mean(values: jax.Array, arrays: Arrays, weight: jax.Array, place: jax.Array | None) -> jax.Array:
    """Values (T, N) less their weighted mean in every grip (pickup and place apart if `place` is given)."""
    parts = (
        [arrays.onehot]
        if place is None
        else [arrays.onehot * (1 - place)[..., None], arrays.onehot * place[..., None]]
    )
    out = values
    for part in parts:
        members = part * weight[..., None]
        members = members / jnp.maximum(members.sum(1, keepdims=True), 1e-9)
        out = out - jnp.einsum("tnm,tm->tn", part, jnp.einsum("tnm,tn->tm", members, values))
    return out * weight


def in_grip(
    values: jax.Array, firm: jax.Array, channel: str, arrays: Arrays, noise: jax.Array, world: World
) -> tuple[jax.Array, jax.Array]:
    """Values (T, N) that are one constant in every grip, less that constant; and their variance's factor.

    Where pads may slide the constant walks at random; the values are less its prediction from those before.
    """
    weight = firm * recorded(arrays, channel)
    sd = noise[..., CHANNELS.index(channel)]

    def followed(values: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _followed(values, weight, sd, world.slip, jnp.asarray(arrays.onehot))

    def centred(values: jax.Array) -> tuple[jax.Array, jax.Array]:
        return less_mean(values, arrays, weight, None), jnp.ones_like(values)

    return jax.lax.cond(jnp.asarray(world.modes)[SLIDING] > 0, followed, centred, values)


def _followed(
    values: jax.Array, weight: jax.Array, sd: jax.Array, slip: jax.Array, grips: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Innovations (T, N) of a Kalman filter, and their variances over sd squared.

    The state is where a grip holds its block; it walks by SLIDE from one sample to the next where pads slide
    at either. A grip's first value sets it and tells nothing.
    """
    other = jnp.concatenate([jnp.ones_like(slip[:, :1]), 1 - (grips[:, 1:] * grips[:, :-1]).sum(-1)], 1)
    before = jnp.concatenate([slip[:, :1], slip[:, :-1]], 1)
    walk = jnp.square(jnp.maximum(slip, before) * SLIDE)

    def step(state, now):
        place, variance, fresh = state
        value, w, s, q, new = now
        variance = jnp.where(new > 0.5, ANYWHERE**2, variance + q)
        fresh = jnp.where(new > 0.5, 1.0, fresh)
        factor = 1 + w * variance / s**2
        miss = value - place
        place = place + w * variance / (s**2 * factor) * miss
        known = 1 - fresh
        out = known * w * miss, 1 + known * (factor - 1)
        return (place, variance / factor, fresh * (1 - w)), out

    rows = [jnp.moveaxis(z, 1, 0) for z in (values, weight, sd, walk, other)]
    start = (values[:, 0], jnp.full_like(values[:, 0], ANYWHERE**2), jnp.ones_like(values[:, 0]))
    _, (out, factor) = jax.lax.scan(step, start, tuple(rows))
    return jnp.moveaxis(out, 0, 1), jnp.moveaxis(factor, 0, 1)
