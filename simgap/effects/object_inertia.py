"""The carried block's inertia, where a quasistatic model is asked for."""

from __future__ import annotations

from simgap.effects.base import CONTACT, Effect, Parameter

EFFECT = Effect(
    name="object_inertia",
    acts_on="dynamics",
    says="m a of the carried block: 1 is the whole of it, 0 a quasistatic block",
    shows="start and stop of a carry",
    mistaken_for=("force_lag",),
    called="inertia of the block that the model leaves out",
    check="Use a dynamic model, or carry more slowly.",
    parameters=(Parameter("scale", "1", 1.0, neutral=1.0, low=-1.0, high=4.0),),
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(inertia=w.inertia + v["scale"] - 1.0),
    chosen=False,
    wrist=True,
)
