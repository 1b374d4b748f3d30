"""Effects of blocks and table: inertia, centre of mass, wrong measurements, tilt, compliance."""

from __future__ import annotations

from typing import Any

import numpy as np

from simgap.effect import Parameter
from simgap.effects.base import (
    CONTACT,
    HAND,
    YIELDING,
    HandEffect,
    Performance,
    Values,
    flat,
    turning_compliance,
    with_force,
    with_mode,
)

# Inertia of the carried block, for use with a quasistatic model.

OBJECT_INERTIA = HandEffect(
    name="object_inertia",
    acts_on="dynamics",
    says="m a of the carried block: 1 is the whole of it, 0 a quasistatic block",
    shows="start and stop of a carry",
    mistaken_for=("force_lag",),
    called="inertia of the block that the model leaves out",
    check="Use a dynamic model, or carry more slowly.",
    parameters={"scale": Parameter(1.0, 1.0, low=-1.0, high=4.0)},
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(inertia=w.inertia + v["scale"] - 1.0),
    chosen=False,
    wrist=True,
)


# A block whose centre of mass is off its middle: the fingers share its weight unequally.


def _apply_offcentre_mass(performance: Performance, values: Values, rng: np.random.Generator) -> Performance:
    """Fingers that stay where they are shear their pads as the block turns between them, by the pads'
    usual compliance (the balance of moments of `simgap.gap.residuals.turned`)."""
    pad, width, force = performance.rig.fingertip, performance.width, flat(performance)
    give = 1 / pad.shear_stiffness
    apart = performance.position[:, 1, 1] - performance.position[:, 0, 1] - give * (force[:, 3] - force[:, 1])
    grip = (force[:, 0] - force[:, 2]) / 2
    moment = grip * apart + (force[:, 3] - force[:, 1]) * width / 2
    # A grip pushes a turned block on, the pads' turning and shear hold it back.
    resists = 1 / turning_compliance(pad.normal_stiffness) - grip * width
    yields = width**2 / (width**2 + 2 * give * resists)
    more = np.where(performance.carried > 0, yields * (performance.carried * values["offset"] - moment), 0.0)
    return with_force(performance, force + (more / width)[:, None] * np.array([0.0, -1.0, 0.0, 1.0]))


OFFCENTRE_MASS = HandEffect(
    name="offcentre_mass",
    acts_on="dynamics",
    says="mass `offset` to the right of the block's middle",
    shows="unequal shear of the two fingers while carried",
    mistaken_for=("force_crosstalk", "force_bias"),
    called="a block heavier on one side",
    check="Balance the block on an edge under its middle.",
    parameters={"offset": Parameter(0.0, 0.003, "m", low=-0.01, high=0.01)},  # physics: within the block
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(couple=w.couple + v["offset"]),
    apply=_apply_offcentre_mass,
)


# A property measured apart from the trials, wrongly.

WRONG = 0.05  # prior: relative error of a wrong measurement


def _wrong_actual(given: Any, push: np.ndarray) -> list[Any]:
    """A candidate for each property that was measured apart from the trials."""
    from simgap.attribution.problem import Candidate

    out, nothing = [], np.zeros(1)
    for o, name in enumerate(given.frame.task.objects):
        for k, kind in enumerate(("weight", "width", "height")):
            column = push[:, 3 * o + k]
            if given.measured[o, k]:
                usual = np.full(1, WRONG * abs(given.centre[o, k]) / given.sd[o, k])
                out.append(Candidate(ACTUAL.name, (f"{name}.{kind}",), nothing, nothing, usual,
                                     np.zeros(len(push)), -column[:, None], np.full(1, -np.inf),
                                     np.full(1, np.inf)))  # fmt: skip
    return out


ACTUAL = HandEffect(
    name="actual",
    acts_on="measurement",
    says="a value of actual.toml is off by a share of itself: its name is the parameter's",
    shows="what depends on that property alone",
    mistaken_for=("force_gain", "fingertip_compliance"),
    called="a measured block property that the recordings contradict",
    check="Weigh and measure the block again, and check the unit in actual.toml.",
    parameters={"property": Parameter(0.0, WRONG)},
    stage=HAND,
    wrong=_wrong_actual,
    wrist=True,
)


# An inclined support.
#
# A block that lands on one edge first turns in the grip until the other edge lands, and pads slide on it. One
# that stood on a slope turns back as it is lifted, by some share of the slope: the fingers' height difference
# changes by that times the block's width.

TABLE_TILT = HandEffect(
    name="table_tilt",
    acts_on="contact",
    says="support inclined by `angle`, rising to the right",
    shows="heights differ with x",
    mistaken_for=("joint_offset", "height"),
    called="a table that is not level",
    check="Lay a spirit level on the table, along the line between the fingers.",
    parameters={
        "angle": Parameter(0.0, 0.025, "rad"),
        "turned": Parameter(0.5, 0.5, low=0.0, high=1.5, hidden=True),
    },
    stage=CONTACT,
    correct=lambda w, v, on: w._replace(tilt=w.tilt + v["angle"], hang=w.hang + v["turned"] * v["angle"]),
    scene=lambda v: {"tilt": v["angle"]},
    wrist=True,
    turns="angle",
    played={"angle": 0.06},
)


# A support that yields under load; its mass and damping delay it by some hundredths of a second.

TABLE_COMPLIANCE = HandEffect(
    name="table_compliance",
    acts_on="contact",
    says="the support yields by load / stiffness",
    shows="height falls with vertical force on the ground",
    mistaken_for=("fingertip_compliance",),
    called="a table that yields under load",
    check="Press on the table with a known weight by a dial gauge; look for foam, a mat or a loose foot.",
    parameters={
        "give": Parameter(0.0, 4e-4, "m/N", low=0.0),
        "settling": Parameter(0.02, 0.8, "s", low=1e-3, high=0.2, log=True, hidden=True),
    },
    stage=CONTACT,
    correct=lambda w, v, on: with_mode(w, YIELDING, on)._replace(
        give_support=w.give_support + v["give"], support_time=w.support_time + on * v["settling"]
    ),
    report=lambda draws, rig: {"stiffness": (1 / draws["give"].clip(1e-7), "N/m")},
    scene=lambda v: {"support_stiffness": v["stiffness"]},
    wrist=True,
    played={"stiffness": 1500.0},
)
