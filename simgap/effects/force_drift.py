"""Force channels that drift linearly from the start of every trial."""

from __future__ import annotations

from simgap.effects.base import (
    FORCES,
    READOUT,
    Effect,
    Parameter,
    Performance,
    World,
    flat,
    per_channel,
    with_force,
)


def _correct(world: World, values, on) -> World:
    since = (world.t - world.t[:, :1])[..., None]
    return world._replace(force=world.force - since * per_channel(values, FORCES))


def _apply(performance: Performance, values, rng) -> Performance:
    since = (performance.t - performance.t[0])[:, None]
    return with_force(performance, flat(performance) + since * [values[c] for c in FORCES])


EFFECT = Effect(
    name="force_drift",
    acts_on="sensing",
    says="recorded F = F + c t, per finger and axis",
    shows="a ramp over the trial, free motion too",
    mistaken_for=("fingertip_creep", "force_bias"),
    parameters=tuple(Parameter(c, "N/s", 0.015) for c in FORCES),
    stage=READOUT,
    correct=_correct,
    apply=_apply,
)
