"""Forces that arrive late by a constant delay: of all channels, or of one finger's sensor."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import FILTER, LATE, Effect, Parameter, Performance, flat, with_force, with_mode
from simgap.effects.filters import of_finger

STARTS = (0.015, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32)  # numerics: s; where searches start


def _delays(values, xp):
    one, two = (xp.asarray(values.get("delay", 0.0) + values.get(n, 0.0)) for n in ("finger1", "finger2"))
    return xp.stack([one, one, two, two])


def _apply(performance: Performance, values, rng) -> Performance:
    t, late = performance.t, _delays(values, np)
    force = flat(performance).T
    return with_force(
        performance, np.stack([np.interp(t - d, t, f) for d, f in zip(late, force, strict=True)], 1)
    )


EFFECT = Effect(
    name="force_lag",
    acts_on="sensing",
    says="recorded F(t) = F(t - delay)",
    shows="every contact change, late",
    mistaken_for=("force_lowpass",),
    called="force readings that come late",
    check=(
        "Tap a fingertip sharply and compare the time stamps of force and motion; look for a buffer in "
        "the force channel."
    ),
    phrase=of_finger("force readings that come late"),
    parameters=(
        Parameter("delay", "s", 0.1, starts=STARTS, low=0.0, high=0.4),
        Parameter("finger1", "s", 0.1, starts=STARTS, low=0.0, high=0.4),
        Parameter("finger2", "s", 0.1, starts=STARTS, low=0.0, high=0.4),
    ),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, LATE, on)._replace(delay=w.delay + _delays(v, jnp)),
    forms=(("delay",), ("finger1",), ("finger2",)),
    apply=_apply,
    wrist=True,
    played={"delay": 0.15},
)
