"""Force channels that read too much or too little, in proportion."""

from __future__ import annotations

from simgap.effects.base import SCALE, Effect, Parameter, flat, with_force

EFFECT = Effect(
    name="force_gain",
    acts_on="sensing",
    says="recorded F = (1 + gain) F, common to all channels",
    shows="every load, in proportion",
    mistaken_for=("weight", "fingertip_compliance"),
    parameters=(Parameter("gain", "1", 0.1, low=-0.5, high=0.5),),
    stage=SCALE,
    correct=lambda w, v, on: w._replace(
        force=w.force / (1 + v["gain"]), loudness=w.loudness * (1 + v["gain"])
    ),
    apply=lambda p, v, rng: with_force(p, flat(p) * (1 + v["gain"])),
)
