"""A constant offset of every force channel."""

from __future__ import annotations

from hmmseg.io.rig import FORCE_CHANNELS
from simgap.effects.base import READOUT, Effect, Parameter, flat, per_channel, with_force


def _phrase(means, rig):
    worst = max(means, key=lambda k: abs(means[k]))
    total = sum(abs(v) for v in means.values())
    lone = total > 0 and abs(means[worst]) > 0.8 * total
    return f"a zero error of force sensor {worst}" if lone else "zero errors of the force sensors"


EFFECT = Effect(
    name="force_bias",
    acts_on="sensing",
    says="recorded F = F + b, per finger and axis",
    shows="all subtasks alike, free motion too",
    mistaken_for=("weight", "fingertip_mass"),
    called="zero errors of the force sensors",
    check="Tare the force sensors in free air, record two seconds at rest, and look at what is left.",
    phrase=_phrase,
    parameters=tuple(Parameter(c, "N", 0.1) for c in FORCE_CHANNELS),
    stage=READOUT,
    correct=lambda w, v, on: w._replace(force=w.force - per_channel(v, FORCE_CHANNELS)),
    admitted=lambda rig: ("force_bias", dict(zip(FORCE_CHANNELS, rig.systematic.force_bias, strict=True))),
    apply=lambda p, v, rng: with_force(p, flat(p) + [v[c] for c in FORCE_CHANNELS]),
)
