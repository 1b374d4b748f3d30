"""Slopes that show the pads, of one grip of one trial: within the grip, and from its landing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.compliance import MIN_SAMPLES, Slope, closed, shear_give, slope, squeeze_give, unit_pads
from estimation.landing import first_push, landing
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.robust import white_sd


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
    root2, pads = np.sqrt(2.0), unit_pads(rig)
    sd_force = np.nan_to_num(signals.sd_force)  # what is not stated is not taken out
    for name, key, place, sd, give, compliance, together in (
        ("distance", "distance", -signals.distance, root2 * signals.sd_x, squeeze_give(signals, rig),
         np.hypot(pads.normal1, pads.normal2), [held["distance"]]),
        ("rise", "place", signals.y, signals.sd_y / root2, shear_give(signals, rig),
         np.hypot(pads.shear1, pads.shear2) / 2, [held["pickup"], held["place"]]),
    ):  # fmt: skip
        known = sd[np.isfinite(sd)]
        noise = float(np.median(known)) if known.size else 0.0
        # What readings are rougher than places is noise of the forces: they ring, what they move does not.
        rough = [_rough(values[key][group]) for group in together]
        ringing = np.sqrt(max(max(rough, default=0.0) ** 2 - noise**2, 0.0))
        sds = (max(sd_force * compliance, ringing), noise)
        found = slope(signals.t, values[key], place, give, together, scales[key], sds)
        if found is not None:
            out[name] = found
    return out


def _rough(readings: np.ndarray) -> float:
    """White noise (sd) of readings (num_samples,), 0 of too few [m]."""
    there = readings[np.isfinite(readings)]
    return white_sd(there) if there.size >= MIN_SAMPLES else 0.0


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
