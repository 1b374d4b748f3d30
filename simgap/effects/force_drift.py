"""Force channels that drift from the start of every trial, evenly or the slower the longer it lasts."""

from __future__ import annotations

import jax.numpy as jnp

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import (
    READOUT,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    per_channel,
    with_force,
)


def _since(t, last, bend):
    """Seconds since the start; what warms up slows down.

    The bend is nothing at the start and as the last block is left: the mean slope stays as it is.
    """
    return t * (1 + bend * (1 - t / last))


def _correct(world: World, values, on) -> World:
    last = jnp.asarray(world.events).max(axis=1, keepdims=True) - world.t[:, :1]
    since = _since(world.t - world.t[:, :1], jnp.maximum(last, 1e-3), values["bend"])
    return world._replace(force=world.force - since[..., None] * per_channel(values, FORCE_CHANNELS))


def _apply(performance: Performance, values, rng) -> Performance:
    t, last = performance.t - performance.t[0], float(performance.events.max() - performance.t[0])
    since = _since(t, max(last, 1e-3), values.get("bend", 0.0))
    return with_force(performance, flat(performance) + since[:, None] * [values[c] for c in FORCE_CHANNELS])


EFFECT = Effect(
    name="force_drift",
    acts_on="sensing",
    says="recorded F = F + c t, per finger and axis",
    shows="a ramp over the trial, free motion too",
    mistaken_for=("fingertip_creep", "force_bias"),
    called="force sensors whose zero drifts",
    check=(
        "Record a minute in free air after switching on; let amplifiers and gauges warm up before a session."
    ),
    parameters=(
        *(Parameter(c, "N/s", 0.015) for c in FORCE_CHANNELS),
        Parameter("bend", "1", 0.15, low=-0.6, high=0.6, hidden=True, shape=True),
    ),
    stage=READOUT,
    correct=_correct,
    apply=_apply,
    played={},  # of a recording as a whole
)
