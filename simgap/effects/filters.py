"""First-order filters along the samples of a trial, exact for what goes straight from sample to sample."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def lowpass(values: jax.Array, time: jax.Array, step: jax.Array) -> jax.Array:
    """First-order low-pass of (T, N, C) along N, started at rest; linear between samples.

    `time` [s]: one of all channels, or (C,).
    """
    time = jnp.reshape(time, (1, 1, -1))
    ratio = step / jnp.maximum(time, 1e-4)
    keep = jnp.exp(-ratio)
    new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
    before = jnp.concatenate([values[:, :1], values[:, :-1]], 1)
    drive = new * values + old * before
    return faded(jnp.concatenate([values[:, :1], drive[:, 1:]], 1), ratio)


def faded(drive: jax.Array, ratio: jax.Array) -> jax.Array:
    """y[k] = exp(-ratio) y[k-1] + drive[k] along N, by doubling: after j rounds y holds the last 2^j."""
    out, reach = drive, 1
    while reach < drive.shape[1]:
        before = jnp.concatenate([jnp.zeros_like(out[:, :reach]), out[:, :-reach]], 1)
        out, reach = out + jnp.exp(-ratio * reach) * before, 2 * reach
    return out
