"""Force channels that read too much or too little, in proportion: all alike, a finger's, or each its own."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import SCALE, Effect, Parameter, World, flat, with_force

FINGERS = ("finger1", "finger2")
EVERY = ("gain", *FINGERS, *FORCE_CHANNELS)
OWN = {c: ("gain", f"finger{c[-1]}", c) for c in FORCE_CHANNELS}  # what gains make up that of a channel


def _gains(values, xp):
    return xp.stack([sum((values.get(n, 0.0) for n in OWN[c]), xp.zeros(())) for c in FORCE_CHANNELS])


def _correct(world: World, values, on) -> World:
    factor = 1 + _gains(values, jnp)
    # Recorded noise over that of corrected forces, of a sum (or difference) of both fingers' channels.
    one, two = factor[:2], factor[2:]
    loud = jnp.sqrt(2 / (one**-2 + two**-2))
    return world._replace(
        force=world.force / factor[None, None, :],
        loudness=world.loudness * jnp.concatenate([loud, loud])[None, None, :],
    )


def _phrase(means, rig):
    which = {k: v for k, v in means.items() if k != "gain"}
    if which:
        worst = max(which, key=lambda k: abs(which[k]))
        where = f"finger {worst[-1]}" if worst.startswith("finger") else worst
        return f"a force sensor that reads too {'high' if which[worst] > 0 else 'low'} ({where})"
    return f"force sensors that read too {'high' if means.get('gain', 0.0) > 0 else 'low'}"


EFFECT = Effect(
    name="force_gain",
    acts_on="sensing",
    says="recorded F = (1 + gain) F, common to all channels, of a finger, or of each channel",
    shows="every load, in proportion",
    mistaken_for=("weight", "fingertip_compliance"),
    called="force sensors that read too high or too low",
    check="Hang a known weight from each fingertip and compare; check the calibration factors in the driver.",
    phrase=_phrase,
    parameters=tuple(Parameter(n, "1", 0.1, low=-0.5, high=0.5) for n in EVERY),
    forms=(("gain",), FINGERS, FORCE_CHANNELS),
    admitted=lambda rig: ("force_gain/2", dict(zip(FORCE_CHANNELS, rig.systematic.force_gain, strict=True))),
    stage=SCALE,
    correct=_correct,
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + _gains(v, np))),
    wrist=True,
)
