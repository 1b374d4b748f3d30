"""Force channels whose gain changes in the course of a trial: what a data sheet calls thermal span shift."""

from __future__ import annotations

import jax.numpy as jnp

from simgap.effects.base import SCALE, Effect, Parameter, World, flat, with_force


def _correct(world: World, values, on) -> World:
    gain = 1 + values["gain"] + values["rate"] * world.t
    gain = jnp.maximum(gain, 0.1)[..., None]
    return world._replace(force=world.force / gain, loudness=world.loudness * gain)


DECOY = Effect(
    name="gain_drift",
    acts_on="sensing",
    says="recorded F = (1 + gain + rate t) F, common to all channels",
    shows="every load, the more the later",
    mistaken_for=("force_gain", "fingertip_creep"),
    parameters=(
        Parameter("rate", "1/s", 0.01, low=-0.05, high=0.05),
        Parameter("gain", "1", 0.1, low=-0.5, high=0.5),
    ),
    stage=SCALE,
    correct=_correct,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"] + v["rate"] * p.t)[:, None]),
    wrist=True,
)
