"""A cable that pulls on the fingers like a spring anchored somewhere."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import HAND, Effect, Parameter, Performance, World, flat, tips, with_force, with_load

MIDDLE = (0.13, 0.02)  # prior: m; about where the fingers work


def _anchor(values, xp):
    """Anchor (4,) for x1, y1, x2, y2; the force at MIDDLE is what is fitted."""
    return xp.stack([xp.asarray(values["at_x"], float), xp.asarray(values["at_y"], float)] * 2)


def _correct(world: World, values, on) -> World:
    position, _ = tips(world)
    offset = position - jnp.asarray(MIDDLE * 2)[None, None, :]
    return with_load(world, values["stiffness"] * offset + _anchor(values, jnp)[None, None, :])


def _apply(performance: Performance, values, rng) -> Performance:
    position = performance.position.reshape(-1, 4)
    pull = values["stiffness"] * (position - np.array([values["x0"], values["y0"]] * 2))
    return with_force(performance, flat(performance) + pull)


def _report(draws, rig):
    k = draws["stiffness"]
    k = np.where(np.abs(k) < 1e-3, 1e-3, k)
    return {
        "stiffness": (draws["stiffness"], "N/m"),
        "x0": (MIDDLE[0] - draws["at_x"] / k, "m"),
        "y0": (MIDDLE[1] - draws["at_y"] / k, "m"),
    }


EFFECT = Effect(
    name="cable_force",
    acts_on="dynamics",
    says="recorded F = F + stiffness (p - p0) on each finger",
    shows="free motion too, by position",
    mistaken_for=("force_bias",),
    called="a cable that pulls at the fingers",
    check="Move the open hand slowly through the workspace and watch the forces; tie the cables elsewhere.",
    parameters=(
        Parameter("stiffness", "N/m", 2.0),
        Parameter("at_x", "N", 0.06),
        Parameter("at_y", "N", 0.06),
    ),
    stage=HAND,
    correct=_correct,
    apply=_apply,
    report=_report,
    wrist=True,
)
