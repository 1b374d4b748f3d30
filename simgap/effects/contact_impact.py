"""A short pulse of vertical force when a block touches down."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import CONTACT, Effect, Parameter, Performance, World, flat, with_force, with_load

LENGTH = 0.06  # numerics: s; a pulse shorter than a sample is known as an impulse only


def _pulse(since, xp):
    """A raised cosine of unit area [1/s] over LENGTH from the event."""
    inside = (since >= 0) & (since < LENGTH)
    return xp.where(inside, (1 - xp.cos(2 * np.pi * since / LENGTH)) / LENGTH, 0.0)


def _correct(world: World, values, on) -> World:
    since = world.t[:, :, None] - world.events[:, None, 2::4]
    pulse = _pulse(since, jnp).sum(-1)[..., None] * jnp.asarray([0.0, 0.5, 0.0, 0.5])[None, None, :]
    return with_load(world, -values["impulse"] * pulse)


def _apply(performance: Performance, values, rng) -> Performance:
    pulse = _pulse(performance.t[:, None] - performance.events[None, 2::4], np).sum(1)
    share = np.array([0.0, 0.5, 0.0, 0.5])
    return with_force(performance, flat(performance) - values["impulse"] * pulse[:, None] * share)


EFFECT = Effect(
    name="contact_impact",
    acts_on="dynamics",
    says="a pulse of -impulse in net fy at touchdown",
    shows="place, first samples",
    mistaken_for=("structural_vibration",),
    called="shocks as blocks touch down",
    check="Set down more slowly, and see whether the gap is gone.",
    parameters=(Parameter("impulse", "N s", 0.03, low=0.0),),
    stage=CONTACT,
    correct=_correct,
    apply=_apply,
    wrist=True,
)
