"""A viscoelastic arm on the pad: foam that goes on yielding while held (standard linear solid).

Stiff at once by (1 + ratio) k and relaxing to k: with the arm's time constant T, displacement d and
force F obey F + T F' = k d + T (1 + ratio) k d'. Solved for d, a share ratio / (1 + ratio) of the
yielding follows the force late, through a low-pass of T (1 + ratio).
"""

from __future__ import annotations

import numpy as np

from simgap.effects.base import CONTACT, CREEPING, Effect, Parameter, Performance, World, with_mode


def _correct(world: World, values, on) -> World:
    ratio = values["ratio"]
    return with_mode(world, CREEPING, on)._replace(
        creep=world.creep + on * ratio / (1 + ratio), creep_time=values["time_constant"] * (1 + ratio)
    )


def _apply(performance: Performance, values, rng) -> Performance:
    """Tips of an unchanged grip force go where such a pad lets them."""
    from scipy.signal import lfilter  # slow to import

    pad, ratio = performance.rig.fingertip, values["ratio"]
    late = values["time_constant"] * (1 + ratio)
    keep = np.exp(-float(np.median(np.diff(performance.t))) / late)
    lagged = np.asarray(lfilter([1 - keep], [1, -keep], performance.force, axis=0))
    more = ratio / (1 + ratio) * (lagged - performance.force)
    give = np.array([1 / pad.normal_stiffness, 1 / pad.shear_stiffness])
    return performance._replace(position=performance.position + more * give)


EFFECT = Effect(
    name="fingertip_creep",
    acts_on="contact",
    says="a viscoelastic arm on the pad (standard linear solid)",
    shows="distance relaxes while held; grip decays",
    mistaken_for=("force_drift", "grip_slip"),
    called="fingertips that keep yielding under load",
    check="Grip a rigid block for ten seconds at constant force and watch the distance of the fingers.",
    parameters=(
        Parameter("ratio", "1", 0.7, starts=(0.3,), low=0.0, high=8.0),
        Parameter(
            "time_constant", "s", 0.8, neutral=0.6, starts=(0.25, 0.7, 1.8), low=0.05, high=8.0, log=True
        ),
    ),
    stage=CONTACT,
    correct=_correct,
    apply=_apply,
)
