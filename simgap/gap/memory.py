"""Mechanics with a memory: a mode that rings, a support that yields late, pads that creep."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from simgap.effects.base import CREEPING, YIELDING, World
from simgap.effects.filters import lowpass
from simgap.gap.between import sampling_interval, when


def sunk(world: World, load: jax.Array) -> jax.Array:
    """How far (T, N) [m] the support yields to what it carries of a block's weight, with its delay.

    Before a grip it has settled under the block; it carries nothing of one that is in the air.
    """

    def sinking(load: jax.Array) -> jax.Array:
        borne = load * (1 - world.carry)
        ratio = sampling_interval(world) / jnp.maximum(world.support_time, 1e-4)
        keep = jnp.exp(-ratio)
        new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
        before = jnp.concatenate([borne[:, :1], borne[:, :-1]], 1)

        def step(depth, now):
            drive, borne, free, carry = now
            depth = (1 - carry) * ((1 - free) * (keep * depth + drive) + free * borne)
            return depth, depth

        rows = tuple(z.T for z in (new * borne + old * before, borne, world.free, world.carry))
        _, out = jax.lax.scan(step, borne[:, 0], rows)
        return out.T

    return world.give_support * when(world, YIELDING, sinking, load)


def driven(world: World, force: jax.Array, back: bool) -> jax.Array:
    """Loads (T, N, C) with the mode that their changes ring; `back`: the loads that rang to these readings.

    The load goes straight from sample to sample: exact in between, a step at a time.
    """
    frequency, damping, drive = (jnp.asarray(world.ring)[k] for k in range(3))
    # The mode as a complex number: (keep_r, keep_i) turns it by a step, (gain_r, gain_i) is what a unit of
    # load, put on evenly over that step, rings it to: (keep - 1) / (fall + 1j turn).
    angle = 2 * jnp.pi * frequency * sampling_interval(world)
    fall, turn = -damping * angle, jnp.sqrt(jnp.maximum(1 - damping**2, 1e-6)) * angle
    keep_r, keep_i = jnp.exp(fall) * jnp.cos(turn), jnp.exp(fall) * jnp.sin(turn)
    size = fall**2 + turn**2
    gain_r = ((keep_r - 1) * fall + keep_i * turn) / size
    gain_i = (keep_i * fall - (keep_r - 1) * turn) / size

    def step(state, now):
        load, ring_r, ring_i = state
        free_r = keep_r * ring_r - keep_i * ring_i - gain_r * load
        free_i = keep_r * ring_i + keep_i * ring_r - gain_i * load
        new = (now - drive * free_i) / (1 + drive * gain_i) if back else now
        state = new, free_r + gain_r * new, free_i + gain_i * new
        return state, new if back else new + drive * state[2]

    start = force[:, 0], jnp.zeros_like(force[:, 0]), jnp.zeros_like(force[:, 0])
    _, out = jax.lax.scan(step, start, jnp.moveaxis(force, 1, 0))
    return jnp.moveaxis(out, 0, 1)


def relaxed(world: World, force: jax.Array) -> jax.Array:
    """Forces (T, N, 4) that would give the pads' displacement at once, for pads that creep."""

    def crept(f: jax.Array) -> jax.Array:
        return f + world.creep * (lowpass(f, world.creep_time, sampling_interval(world)) - f)

    return when(world, CREEPING, crept, force)
