"""Pads that are stiffer or softer than nominal."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import CONTACT, Effect, Parameter, World


def _correct(world: World, values, on) -> World:
    normal, shear = jnp.asarray(values["give_normal"], float), jnp.asarray(values["give_shear"], float)
    return world._replace(
        give_normal=world.give_normal + normal[None], give_shear=world.give_shear + shear[None]
    )


def _report(draws, rig):
    """True stiffnesses [N/m] from the additional compliances; a pad is never stiffer than 1e6 N/m."""
    tip = rig.fingertip
    return {
        "normal_stiffness": (1 / np.maximum(1 / tip.normal_stiffness + draws["give_normal"], 1e-6), "N/m"),
        "shear_stiffness": (1 / np.maximum(1 / tip.shear_stiffness + draws["give_shear"], 1e-6), "N/m"),
    }


EFFECT = Effect(
    name="fingertip_compliance",
    acts_on="contact",
    says="pad stiffness differs from nominal (or is finite at all)",
    shows="distance follows grip force",
    mistaken_for=("width", "joint_offset", "force_gain"),
    parameters=(
        Parameter("give_normal", "m/N", 4e-4, low=-2.4e-4),
        Parameter("give_shear", "m/N", 4e-4, low=-3.8e-4),
    ),
    stage=CONTACT,
    form=0.035,  # real pads are no linear springs: their secant changes with the grip
    correct=_correct,
    report=_report,
    scene=lambda v: {"normal_stiffness": v["normal_stiffness"], "shear_stiffness": v["shear_stiffness"]},
)
