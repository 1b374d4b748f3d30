"""A support that yields under load."""

from __future__ import annotations

from simgap.effects.base import CONTACT, Effect, Parameter


def _report(draws, rig):
    return {"stiffness": (1 / draws["give"].clip(1e-7), "N/m")}


EFFECT = Effect(
    name="table_compliance",
    acts_on="contact",
    says="the support yields by load / stiffness",
    shows="height falls with vertical force on the ground",
    mistaken_for=("fingertip_compliance",),
    parameters=(Parameter("give", "m/N", 4e-4, low=0.0),),
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(give_support=w.give_support + v["give"]),
    report=_report,
    scene=lambda v: {"support_stiffness": v["stiffness"]},
    coarse=True,
)
