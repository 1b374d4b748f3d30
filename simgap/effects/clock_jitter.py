"""Samples taken at irregular times and stamped as if regular."""

from __future__ import annotations

from simgap.effects.base import READOUT, Effect, Parameter

EFFECT = Effect(
    name="clock_jitter",
    acts_on="sensing",
    says="true sample times = t + normal(0, sd)",
    shows="noise in proportion to the rate of change",
    mistaken_for=("noise",),
    parameters=(Parameter("sd", "s", 1.0, neutral=0.004, log=True, low=1e-4, high=0.05),),
    stage=READOUT,
    coarse=True,
    form=0.12,  # changes of speed within a sample count as well, and errors of time need not be normal
)
