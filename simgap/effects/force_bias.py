"""A constant offset of every force channel."""

from __future__ import annotations

from simgap.effects.base import FORCES, READOUT, Effect, Parameter, flat, per_channel, with_force

EFFECT = Effect(
    name="force_bias",
    acts_on="sensing",
    says="recorded F = F + b, per finger and axis",
    shows="all subtasks alike, free motion too",
    mistaken_for=("weight", "fingertip_mass"),
    parameters=tuple(Parameter(c, "N", 0.1) for c in FORCES),
    stage=READOUT,
    correct=lambda w, v, on: w._replace(force=w.force - per_channel(v, FORCES)),
    admitted=lambda rig: ("force_bias", dict(zip(FORCES, rig.systematic.force_bias, strict=True))),
    apply=lambda p, v, rng: with_force(p, flat(p) + [v[c] for c in FORCES]),
)
