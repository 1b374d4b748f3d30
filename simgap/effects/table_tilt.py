"""A support inclined from the horizontal."""

from __future__ import annotations

from simgap.effects.base import CONTACT, Effect, Parameter

EFFECT = Effect(
    name="table_tilt",
    acts_on="contact",
    says="support inclined by `angle`, rising to the right",
    shows="heights differ with x",
    mistaken_for=("joint_offset", "height"),
    parameters=(Parameter("angle", "rad", 0.025),),
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(tilt=w.tilt + v["angle"]),
    scene=lambda v: {"tilt": v["angle"]},
    wrist=True,
    played={"angle": 0.06},
)
