"""Links longer or shorter than nominal: all alike, or each by its own."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import KINEMATICS, Effect, Parameter
from simgap.effects.kinematics import moved_joints

LINKS = ("link11", "link12", "link21", "link22")


def _longer(values, xp):
    return xp.stack([xp.asarray(values.get("scale", 0.0) + values.get(n, 0.0)) for n in LINKS])


def _patched(document, found):
    """Links longer by `scale`, all of them, or each by its own: link11 is finger 1's first."""
    from simgap.patch.write import interval_comment, number

    if "fingers" not in document:
        return None
    common = found["scale"]["mean"] if "scale" in found else 0.0
    for name, finger in document["fingers"].items():
        before = [float(v) for v in finger["links"]]
        own = [found.get(f"link{name}{k}") for k in (1, 2)]
        factors = [1 + common + (p["mean"] if p else 0.0) for p in own]
        finger["links"] = [number(v * f) for v, f in zip(before, factors, strict=True)]
        said = [interval_comment(p) for p in (found.get("scale"), *own) if p]
        finger["links"].comment(f"was {before}; share longer: {'; '.join(said)}")
    return {k: f"fingers.links.{k}" for k in found}


EFFECT = Effect(
    name="link_length",
    acts_on="kinematics",
    says="true link = (1 + scale) nominal, all links or each",
    shows="positions in proportion to reach",
    mistaken_for=("joint_offset",),
    called="links of another length than the model's",
    check="Measure the links from axis to axis, or touch two points a known distance apart.",
    parameters=tuple(Parameter(n, "1", 0.02, low=-0.2, high=0.2) for n in ("scale", *LINKS)),
    forms=(("scale",), LINKS),
    admitted=lambda rig: ("link_length/1", dict(zip(LINKS, rig.systematic.link_length, strict=True))),
    stage=KINEMATICS,
    patched=_patched,
    correct=lambda w, v, on: w._replace(link=w.link * (1 + _longer(v, jnp))),
    apply=lambda p, v, rng: moved_joints(p, lambda q, dq: (q, dq), _longer(v, np).tolist()),
)
