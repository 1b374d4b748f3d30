"""A hand that is not as its drawing says: any angles, lengths and places of its links."""

from __future__ import annotations

import jax.numpy as jnp

from simgap.effects.base import KINEMATICS, Effect, Parameter, World, per_channel
from simgap.effects.joint_offset import JOINTS
from simgap.effects.kinematics import moved_joints

LINKS = ("link11", "link12", "link21", "link22")
BASE = ("base_x", "base_y")


def _correct(world: World, values, on) -> World:
    scales = jnp.stack([jnp.asarray(values[n], float) for n in LINKS])
    apart = jnp.stack([jnp.asarray(values[n], float) for n in BASE])
    return world._replace(
        joints=world.joints - per_channel(values, JOINTS) * world.jointed,
        link=world.link * (1 + scales),
        base=world.base + jnp.concatenate([jnp.zeros(2), apart]),
    )


DECOY = Effect(
    name="hand_geometry",
    acts_on="kinematics",
    says="offsets of every joint, lengths of every link, and the second finger's base, all off",
    shows="positions, widths, heights, by pose",
    mistaken_for=("joint_offset", "link_length"),
    parameters=(
        *(Parameter(q, "rad", 0.012) for q in JOINTS),
        *(Parameter(link, "1", 0.02, low=-0.2, high=0.2) for link in LINKS),
        *(Parameter(axis, "m", 1e-3) for axis in BASE),
    ),
    stage=KINEMATICS,
    correct=_correct,
    apply=lambda p, v, rng: moved_joints(
        p, lambda q, dq: (q + [v[n] for n in JOINTS], dq), [v[n] for n in LINKS], [v[n] for n in BASE]
    ),
)
