"""Forces that pass a first-order low-pass."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from simgap.effects.base import FILTER, SMOOTH, Effect, Parameter, Performance, flat, with_force, with_mode
from simgap.effects.filters import of_finger

STARTS = (0.02, 0.06, 0.12, 0.2)  # numerics: s; where searches start


def _times(values, xp):
    common = values.get("time_constant", 0.0)
    one, two = (xp.asarray(common + values.get(n, 0.0)) for n in ("finger1", "finger2"))
    return xp.stack([one, one, two, two])


def _apply(performance: Performance, values, rng) -> Performance:
    from scipy.signal import lfilter  # slow to import

    step = float(np.median(np.diff(performance.t)))
    out = flat(performance).copy()
    for c, time in enumerate(_times(values, np)):
        keep = np.exp(-step / max(time, 1e-6))
        out[:, c] = lfilter([1 - keep], [1, -keep], out[:, c])
    return with_force(performance, out)


EFFECT = Effect(
    name="force_lowpass",
    acts_on="sensing",
    says="time_constant dF_rec/dt + F_rec = F",
    shows="rounded contact changes",
    mistaken_for=("force_lag",),
    called="a slow filter in the force channel",
    check=(
        "Look up the filter setting of the force amplifier or driver; tap a fingertip and see how fast "
        "the reading rises."
    ),
    phrase=of_finger("a slow filter in the force channel"),
    parameters=(
        Parameter("time_constant", "s", 0.08, starts=STARTS, low=0.0, high=0.5),
        Parameter("finger1", "s", 0.08, starts=STARTS, low=0.0, high=0.5),
        Parameter("finger2", "s", 0.08, starts=STARTS, low=0.0, high=0.5),
    ),
    forms=(("time_constant",), ("finger1",), ("finger2",)),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, SMOOTH, on)._replace(smoothing=w.smoothing + _times(v, jnp)),
    apply=_apply,
    wrist=True,
    played={"time_constant": 0.15},
)
