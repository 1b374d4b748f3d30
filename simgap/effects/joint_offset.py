"""Joint angles read with constant offsets."""

from __future__ import annotations

from simgap.effects.base import KINEMATICS, Effect, Parameter, per_channel
from simgap.effects.kinematics import moved_joints

JOINTS = ("q11", "q12", "q21", "q22")

EFFECT = Effect(
    name="joint_offset",
    acts_on="kinematics",
    says="recorded q = q + q0, per joint",
    shows="positions, widths, heights, by pose",
    mistaken_for=("link_length",),
    called="joint angles with a wrong zero",
    check=(
        "Home the joints again against their stops, or put the fingertips on a gauge block and compare "
        "angles."
    ),
    parameters=tuple(Parameter(q, "rad", 0.012) for q in JOINTS),
    admitted=lambda rig: ("joint_offset", dict(zip(JOINTS, rig.systematic.joint_offset, strict=True))),
    stage=KINEMATICS,
    restored=lambda channels, v: channels | {q: channels[q] - value for q, value in v.items()},
    correct=lambda w, v, on: w._replace(joints=w.joints - per_channel(v, JOINTS) * w.jointed),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q + [v[n] for n in JOINTS], dq)),
)
