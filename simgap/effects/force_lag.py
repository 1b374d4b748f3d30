"""Forces that arrive late by a constant delay."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import FILTER, LATE, Effect, Parameter, Performance, flat, with_force, with_mode


def _apply(performance: Performance, values, rng) -> Performance:
    force, late = flat(performance), performance.t - values["delay"]
    return with_force(performance, np.stack([np.interp(late, performance.t, f) for f in force.T], 1))


EFFECT = Effect(
    name="force_lag",
    acts_on="sensing",
    says="recorded F(t) = F(t - delay)",
    shows="every contact change, late",
    mistaken_for=("force_lowpass",),
    parameters=(
        Parameter(
            "delay", "s", 0.1, starts=(0.015, 0.04, 0.07, 0.1, 0.14, 0.19, 0.25, 0.32), low=0.0, high=0.4
        ),
    ),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, LATE, on)._replace(delay=w.delay + v["delay"]),
    apply=_apply,
    coarse=True,
)
