"""A support inclined from the horizontal.

A block of which one foot touches first turns in the grip until the other one does, and pads slide on it.
"""

from __future__ import annotations

from simgap.effects.base import CONTACT, Effect, Parameter

EFFECT = Effect(
    name="table_tilt",
    acts_on="contact",
    says="support inclined by `angle`, rising to the right",
    shows="heights differ with x",
    mistaken_for=("joint_offset", "height"),
    called="a table that is not level",
    check="Lay a spirit level on the table, along the line between the fingers.",
    parameters=(Parameter("angle", "rad", 0.025),),
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(tilt=w.tilt + v["angle"]),
    scene=lambda v: {"tilt": v["angle"]},
    wrist=True,
    turns="angle",
    played={"angle": 0.06},
)
