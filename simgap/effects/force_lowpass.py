"""Forces that pass a first-order low-pass."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import FILTER, SMOOTH, Effect, Parameter, Performance, flat, with_force, with_mode


def _apply(performance: Performance, values, rng) -> Performance:
    from scipy.signal import lfilter  # slow to import

    step = float(np.median(np.diff(performance.t)))
    keep = np.exp(-step / max(values["time_constant"], 1e-6))
    force = flat(performance)
    return with_force(performance, np.asarray(lfilter([1 - keep], [1, -keep], force, axis=0)))


EFFECT = Effect(
    name="force_lowpass",
    acts_on="sensing",
    says="time_constant dF_rec/dt + F_rec = F",
    shows="rounded contact changes",
    mistaken_for=("force_lag",),
    parameters=(Parameter("time_constant", "s", 0.08, starts=(0.02, 0.06, 0.12, 0.2), low=0.0, high=0.5),),
    stage=FILTER,
    correct=lambda w, v, on: with_mode(w, SMOOTH, on)._replace(smoothing=w.smoothing + v["time_constant"]),
    apply=_apply,
    coarse=True,
    blur=2.5e-3,  # a contact that changes between two samples: a twentieth of them
)
