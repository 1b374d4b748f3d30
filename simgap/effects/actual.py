"""A property that was measured apart from the trials, and is wrong."""

from __future__ import annotations

from simgap.effects.base import HAND, Effect, Parameter

EFFECT = Effect(
    name="actual",
    acts_on="measurement",
    says="a value of actual.toml is off by a share of itself: its name is the parameter's",
    shows="what depends on that property alone",
    mistaken_for=("force_gain", "fingertip_compliance"),
    parameters=(Parameter("property", "1", 0.05),),
    stage=HAND,
    wrist=True,
)
