"""Force sensors mounted with a turn."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import MIX, Effect, Parameter, Performance, World, flat, with_force


def _turned(force, angles, xp):
    out = []
    for finger, angle in enumerate(angles):
        fx, fy = force[..., 2 * finger], force[..., 2 * finger + 1]
        out += [xp.cos(angle) * fx - xp.sin(angle) * fy, xp.sin(angle) * fx + xp.cos(angle) * fy]
    return xp.stack(out, -1)


def _correct(world: World, values, on) -> World:
    return world._replace(force=_turned(world.force, (-values["angle1"], -values["angle2"]), jnp))


def _apply(performance: Performance, values, rng) -> Performance:
    return with_force(performance, _turned(flat(performance), (values["angle1"], values["angle2"]), np))


EFFECT = Effect(
    name="sensor_rotation",
    acts_on="sensing",
    says="recorded F = R(angle) F, per finger",
    shows="both axes, antisymmetric",
    mistaken_for=("force_crosstalk", "table_tilt"),
    called="a force sensor mounted at an angle",
    check="Check the mounting screws and the stated sensor frame: pull along one axis and read the other.",
    parameters=tuple(Parameter(n, "rad", 0.06, low=-0.6, high=0.6) for n in ("angle1", "angle2")),
    stage=MIX,
    correct=_correct,
    apply=_apply,
)
