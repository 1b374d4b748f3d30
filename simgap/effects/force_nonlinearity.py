"""A force sensor whose gain changes with its load: what a data sheet calls non-linearity."""

from __future__ import annotations

import jax.numpy as jnp

from simgap.effects.base import SCALE, Effect, Parameter, World, flat, with_force


def _correct(world: World, values, on) -> World:
    size, gain, curve = jnp.abs(world.force), 1 + values["gain"], values["curve"]
    root = jnp.sqrt(jnp.maximum(gain**2 + 4 * curve * size, 0.05))
    louder = (root[..., :2] + root[..., 2:]) / 2  # the slope of the reading is that root
    return world._replace(
        force=jnp.sign(world.force) * 2 * size / (gain + root),
        loudness=world.loudness * jnp.concatenate([louder, louder], -1),
    )


DECOY = Effect(
    name="force_nonlinearity",
    acts_on="sensing",
    says="recorded F = (1 + gain) F + curve F |F|, common to all channels",
    shows="every load, the more the larger it is",
    mistaken_for=("force_gain", "fingertip_compliance"),
    parameters=(
        Parameter("curve", "1/N", 0.1, low=-0.2, high=0.5),
        Parameter("gain", "1", 0.1, low=-0.5, high=0.5),
    ),
    stage=SCALE,
    correct=_correct,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["curve"] * abs(flat(p)))),
    wrist=True,
)
