"""Effects from outside the catalogue of the second sealed set of worlds: loads remembered, induced, swung."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.effects import _sign, fault
from experiments.blind_check.signals import ENCODER, READOUT, SCALE, Signals, Stage
from experiments.blind_check.stages import Rng, Values, added_force


def remembered(v: Values) -> Stage:
    """A sensor's elastomer keeps a share of the heaviest load so far for as long as it bears less."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        most = np.maximum.accumulate(np.abs(s.force), axis=0)
        return v["share"] * np.sign(s.force) * (most - np.abs(s.force)) * (np.abs(s.force) > 0.05)

    return added_force(shift)


def induced(v: Values) -> Stage:
    """The cable of one finger's sensor lies beside the other's: its reading takes up changes of that load."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        slope = np.gradient(s.force, s.t, axis=0)
        a = np.exp(-1e-3 / 0.01)
        slow = lfilter([1 - a], [1, -a], slope, axis=0)
        return v["time"] * slow[:, [2, 3, 0, 1]]

    return added_force(shift)


def sheared(v: Values) -> Stage:
    """A timing belt on the outer joint stretches with the square of the speed."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        bent = np.array([0.0, 1.0, 0.0, 1.0]) * v["stretch"]
        q = s.q - bent * s.dq * np.abs(s.dq)
        return replace(s, q=q, dq=np.gradient(q, s.t, axis=0))

    return stage


def limping(v: Values) -> Stage:
    """An amplifier's gain swings slowly, as its supply does, each trial at its own phase."""

    def stage(s: Signals, rng: Rng) -> Signals:
        wave = np.sin(2 * np.pi * v["frequency"] * s.t + rng.uniform(0, 2 * np.pi))
        return replace(s, force=s.force * (1 + v["depth"] * wave[:, None]))

    return stage


OUTSIDE = {
    made.name: made
    for made in (
        fault("remembered_load", lambda r, s: {"share": 0.12 * s * _sign(r)}, READOUT, remembered),
        fault("induced_rate", lambda r, s: {"time": 0.012 * s * _sign(r)}, READOUT, induced),
        fault("stretching_belt", lambda r, s: {"stretch": 0.006 * s * _sign(r)}, ENCODER, sheared),
        fault(
            "limping_supply",
            lambda r, s: {"depth": 0.1 * s, "frequency": r.uniform(0.3, 1.5)},
            SCALE,
            limping,
        ),
    )
}  # fmt: skip
