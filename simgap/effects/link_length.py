"""Links longer or shorter than nominal: all alike, or each by its own."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter
from simgap.effects.kinematics import moved_joints

LINKS = ("link11", "link12", "link21", "link22")


def _longer(values, xp):
    return xp.stack([xp.asarray(values.get("scale", 0.0) + values.get(n, 0.0)) for n in LINKS])


EFFECT = Effect(
    name="link_length",
    acts_on="kinematics",
    says="true link = (1 + scale) nominal, all links or each",
    shows="positions in proportion to reach",
    mistaken_for=("joint_offset",),
    parameters=tuple(Parameter(n, "1", 0.02, low=-0.2, high=0.2) for n in ("scale", *LINKS)),
    forms=(("scale",), LINKS),
    admitted=lambda rig: ("link_length/1", dict(zip(LINKS, rig.systematic.link_length, strict=True))),
    stage=KINEMATICS,
    correct=lambda w, v, on: w._replace(link=w.link * (1 + _longer(v, jnp))),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q, dq), _longer(v, np).tolist()),
)
