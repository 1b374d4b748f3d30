"""A support that yields under load, a little late."""

from __future__ import annotations

from simgap.effects.base import CONTACT, YIELDING, Effect, Parameter, World, with_mode


def _correct(world: World, values, on) -> World:
    # What yields has mass and damping: it is late by some hundredths of a second.
    return with_mode(world, YIELDING, on)._replace(
        give_support=world.give_support + values["give"],
        support_time=world.support_time + on * values["settling"],
    )


def _report(draws, rig):
    return {"stiffness": (1 / draws["give"].clip(1e-7), "N/m")}


EFFECT = Effect(
    name="table_compliance",
    acts_on="contact",
    says="the support yields by load / stiffness",
    shows="height falls with vertical force on the ground",
    mistaken_for=("fingertip_compliance",),
    called="a table that yields under load",
    check="Press on the table with a known weight beside a dial gauge; look for foam, a mat or a loose foot.",
    parameters=(
        Parameter("give", "m/N", 4e-4, low=0.0),
        Parameter("settling", "s", 0.8, neutral=0.02, low=1e-3, high=0.2, log=True, hidden=True),
    ),
    stage=CONTACT,
    correct=_correct,
    report=_report,
    scene=lambda v: {"support_stiffness": v["stiffness"]},
    wrist=True,
    played={"stiffness": 1500.0},
)
