"""Pads that slide on the block when the shear exceeds mu times the normal force.

A slide shows as a shift of the fingers against the block that grows only while the shear is at its
bound. How far it slides is free in every grip (marginalised with the grip's other constants); when
is told by mu.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from simgap.effects.base import CONTACT, SLIDING, Effect, Parameter, World, with_mode

# chosen: N; a grip lighter than this is opening or closing, when pads slide on healthy hands too
LOADED = 0.4
HANGING = 0.9  # chosen: share of a carry, at least, that pads do not slide in: or the block would fall


def _correct(world: World, values, on) -> World:
    force = world.force - world.load
    shear = jnp.abs(force[..., jnp.asarray([1, 3])])
    push = jnp.stack([force[..., 0], -force[..., 2]], -1)
    ratio = shear / jnp.maximum(push, 0.5 * LOADED)
    carried = (world.carry > 0) & (push.min(axis=-1) > LOADED)
    unknown = jnp.where(carried.any(), jnp.nan, 0.0)
    steady = jnp.nanquantile(jnp.where(carried, ratio.max(axis=-1), unknown), HANGING)
    mu = jnp.maximum(values["mu"], 1.05 * steady)
    sliding = jax.nn.sigmoid((ratio / mu - 1.02) / 0.02).max(axis=-1)
    sliding = sliding * jax.nn.sigmoid((push.min(axis=-1) - LOADED) / 0.05)
    return with_mode(world, SLIDING, on)._replace(
        slip=world.slip + on * sliding * (world.ground + world.carry)
    )


EFFECT = Effect(
    name="grip_slip",
    acts_on="contact",
    says="the pad slides on the block when shear exceeds mu N",
    shows="height changes that do not come back, at impact",
    mistaken_for=("fingertip_creep",),
    called="blocks that slip in the grip",
    check="Mark the block at the pad and lift it harder than usual; clean the pads, or grip more firmly.",
    parameters=(
        Parameter(
            "mu",
            "1",
            0.6,
            neutral=0.5,
            starts=(0.2, 0.28, 0.36, 0.46, 0.6, 0.8),
            low=0.08,
            high=1.5,
            log=True,
        ),
    ),
    stage=CONTACT,
    correct=_correct,
    scene=lambda v: {"friction": v["mu"]},
    grip=(1.2, 1.8),  # chosen: N: so lightly that pads of a low friction slide
    played={"mu": 0.12},
)
