"""Forces rounded to a step."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import READOUT, Effect, Parameter

EFFECT = Effect(
    name="quantisation",
    acts_on="sensing",
    says="recorded F = step * round(F / step)",
    shows="plateaus; repeated values",
    mistaken_for=("noise",),
    parameters=(Parameter("step", "N", 1.0, neutral=0.05, log=True, low=1e-3, high=0.5),),
    stage=READOUT,
    finish=lambda force, v: v["step"] * np.round(force / v["step"]),
)
