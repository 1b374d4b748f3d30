"""Slopes that show the pads, of one grip of one trial: within the grip, and from its landing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.compliance import Slope, closed, shear_give, slope, squeeze_give
from estimation.landing import first_push, landing
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig


def slopes_within(
    signals: Signals, values: Mapping[str, np.ndarray], groups: Mapping[str, np.ndarray],
    scales: Mapping[str, float], rig: Rig,
) -> dict[str, Slope]:  # fmt: skip
    """Slopes of the width's and the height's readings over the pads' give, within one grip.

    `values`: readings (num_timesteps,) by name; `groups`: booleans (num_timesteps,) of the samples while the
    block is held ("distance"), before it is lifted ("pickup") and after ("place").
    """
    out = {}
    held = {name: closed(signals, group) for name, group in groups.items()}
    for name, key, give, together in (
        ("distance", "distance", squeeze_give(signals, rig), [held["distance"]]),
        ("rise", "place", shear_give(signals, rig), [held["pickup"], held["place"]]),
    ):
        found = slope(signals.t, values[key], give, together, scales[key])
        if found is not None:
            out[name] = found
    return out


def slope_of_landing(
    signals: Signals, values: Mapping[str, np.ndarray], net: np.ndarray, carry: np.ndarray,
    place: np.ndarray, touch: tuple[float, float], scales: Mapping[str, float], rig: Rig,
) -> dict[str, Slope]:  # fmt: skip
    """What the landing of one grip says of the pads, if anything.

    `net` (num_timesteps,) [N]: net vertical force in units of 1 + a / g; `carry`, `place` (num_timesteps,):
    samples before it and weights of the place's mean; `touch`: mean and sd of the boundary [s].
    """
    give, moment = shear_give(signals, rig), first_push(signals.t, net, carry, touch)
    found = landing(signals.t, values["place"], give, place, moment, carry, scales["place"])
    return {} if found is None else {"landing": found}
