"""A block whose mass lies beside its middle: the fingers share its weight unequally."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import CONTACT, Effect, Parameter, Performance, flat, with_force


def _apply(performance: Performance, values, rng) -> Performance:
    more = performance.carried * values["offset"] / performance.width
    return with_force(performance, flat(performance) + more[:, None] * np.array([0.0, -1.0, 0.0, 1.0]))


EFFECT = Effect(
    name="offcentre_mass",
    acts_on="dynamics",
    says="mass `offset` to the right of the block's middle",
    shows="unequal shear of the two fingers while carried",
    mistaken_for=("force_crosstalk", "force_bias"),
    called="a block heavier on one side",
    check="Balance the block on an edge under its middle.",
    parameters=(Parameter("offset", "m", 0.003),),
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(couple=w.couple + v["offset"]),
    apply=_apply,
)
