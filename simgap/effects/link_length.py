"""Links longer or shorter than nominal."""

from __future__ import annotations

from simgap.effects.base import KINEMATICS, Effect, Parameter
from simgap.effects.kinematics import moved_joints

EFFECT = Effect(
    name="link_length",
    acts_on="kinematics",
    says="true link = (1 + scale) nominal, all links",
    shows="positions in proportion to reach",
    mistaken_for=("joint_offset",),
    parameters=(Parameter("scale", "1", 0.02, low=-0.2, high=0.2),),
    stage=KINEMATICS,
    correct=lambda w, v, on: w._replace(link=w.link * (1 + v["scale"])),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q, dq), v["scale"]),
)
