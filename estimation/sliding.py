"""Blocks that slide in the pads as they are set down: their heights are as uncertain as they slid.

Pads that creep, or whose friction is spent, let the fingers go on down after their block stands, by however
far the hand moves on: no share of the pads' give, which the balance of forces tells, and up to a millimetre
and a half on a robot arm's stock pads. A landing whose fingers went on further than its give times what
the rig and all slopes have in common has slid. The mean height over its place is off by as much, and the
height at the touch would be no better: what slides under a push has slid under the block's weight before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation.channel_noise import Noise
from estimation.compliance import SLOPE_SD, UNSTATED, Slope, middle_share
from estimation.observations import WeighedTrial, channel_values
from hmmseg.io.rig import Rig

SEEN = 3.0  # chosen: standard errors beyond which a landing is a slide
WITNESSES = ("rise", "landing")


def with_slides(weighed: Sequence[WeighedTrial], noise: Noise, rig: Rig) -> list[WeighedTrial]:
    """The trials with places counting for less where their blocks slid; others as they are.

    A landing in which a block slid is no witness of the pads any more.
    """
    readings = [np.nan_to_num(channel_values(a.signals, rig)["place"]) for a in weighed]
    slopes = [
        (float(found.weights @ reading), found.variance)
        for a, reading in zip(weighed, readings, strict=True)
        for of_move in a.weights.slopes.values()
        for name, found in of_move.items()
        if name in WITNESSES
    ]
    if not slopes:
        return list(weighed)
    stated = np.isfinite(rig.fingertip.shear_stiffness)
    believed = max(rig.systematic.pad_stiffness) if stated else UNSTATED
    shares, variances = np.array([(0.0, believed**2), *slopes]).T
    common, _ = middle_share(shares, variances, SLOPE_SD)
    return [
        _doubted(a, reading, common, noise.variance["place"])
        for a, reading in zip(weighed, readings, strict=True)
    ]


def _doubted(a: WeighedTrial, reading: np.ndarray, common: float, variance: float) -> WeighedTrial:
    counts, slopes = dict(a.weights.counts), dict(a.weights.slopes)
    for move, of_move in a.weights.slopes.items():
        found = of_move.get("landing")
        slid = 0.0 if found is None else _slid(found, float(found.weights @ reading), common)
        if slid:
            usual = counts[move]["place"]
            counts[move] = counts[move] | {"place": usual / (1 + usual * slid**2 / variance)}
            slopes[move] = {name: s for name, s in of_move.items() if name != "landing"}
    return replace(a, weights=replace(a.weights, counts=counts, slopes=slopes))


def _slid(found: Slope, share: float, common: float) -> float:
    """How far [m] a landing went beyond what its pads gave; 0 where it need not have."""
    doubt = float(np.sqrt(found.variance + (SLOPE_SD * max(abs(common), 1.0)) ** 2))
    return (share - common) * found.change if abs(share - common) > SEEN * doubt else 0.0
