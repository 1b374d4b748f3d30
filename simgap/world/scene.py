"""The calibrated scene: constants of the dynamics from a rig and blocks, and its fastest mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from hmmseg.io.rig import Rig
from simgap.world.dynamics import Physics
from simgap.world.properties import Block

RIGID_PAD = 1e5  # numerics: N/m in place of inf: 3 N of grip compress such a pad by 0.03 mm


@dataclass(frozen=True)
class Surroundings:
    """What a rig does not state: supports and the foam's damping.

    Supports are stiff springs [N/m] with damping (ratio to critical, one block) and friction;
    the foam's damping is its time constant [s], damping over stiffness; the ground's `tilt` [rad].
    """

    support_stiffness: float = 4e5
    support_damping: float = 0.5
    support_friction: float = 0.5
    pad_time: float = 2e-3
    tilt: float = 0.0


def physics(rig: Rig, blocks: Sequence[Block], surroundings: Surroundings | None = None) -> Physics:
    """Constants of the dynamics for blocks in order; a rigid pad becomes one of RIGID_PAD."""
    around = surroundings or Surroundings()

    def scalars(values: Sequence[float]) -> tuple[Array, ...]:
        return tuple(jnp.asarray(v, float) for v in values)

    pad = rig.fingertip
    return Physics(
        weight=scalars([b.weight for b in blocks]),
        width=scalars([b.width for b in blocks]),
        height=scalars([b.height for b in blocks]),
        friction=scalars([b.friction for b in blocks]),
        pad_normal=scalars([finite_stiffness(pad.normal_stiffness)] * 2),
        pad_shear=scalars([finite_stiffness(pad.shear_stiffness)] * 2),
        pad_time=jnp.asarray(around.pad_time, float),
        support_stiffness=jnp.asarray(around.support_stiffness, float),
        support_damping=jnp.asarray(around.support_damping, float),
        support_friction=jnp.asarray(around.support_friction, float),
        gravity=jnp.asarray(rig.gravity, float),
        tilt=jnp.asarray(around.tilt, float),
    )


def finite_stiffness(stiffness: float) -> float:
    """A pad's stiffness [N/m], with the substitute for a rigid one."""
    return stiffness if math.isfinite(stiffness) else RIGID_PAD


def substeps_for(constants: Physics, period: float) -> int:
    """Substeps in a period [s] that keep the integration well inside its stability limit.

    By Gershgorin no block oscillates faster than sqrt((4 supports + both pads) / mass), as in the
    middle of a stack. The step is held to 1.1 over that frequency (the limit is 2), to 0.8 over the
    pads' damping rate and to 0.25 ms; a power of two, so that few programs are compiled.
    """
    step = 2.5e-4
    pads = max(sum(map(float, constants.pad_normal)), sum(map(float, constants.pad_shear)))
    for w in constants.weight:
        mass = float(w) / float(constants.gravity)
        step = min(step, 1.1 / math.sqrt((4 * float(constants.support_stiffness) + pads) / mass))
        step = min(step, 0.8 / max(pads * float(constants.pad_time) / mass, 1e-9))
    return 2 ** max(0, math.ceil(math.log2(period / step) - 1e-9))
