"""The smallest gap that matters: what rig.toml says under [tolerance], or what its sensors could not show."""

from __future__ import annotations

import numpy as np

from simgap.gap.problem import Problem
from simgap.gap.trial_arrays import CHANNELS

SAMPLES = 0.5  # chosen: sds of one sample: a shift below that is not seen in any single one
PROPERTY = 0.01  # chosen: the same, of a property
SHARE = 0.005  # cited: of a block's width or weight: the better half of the paper's own errors (its Table 4)


def properties_tolerated(given: Problem) -> np.ndarray:
    """By how much properties (3 O,) may be off before it matters, in sds of their prior."""
    share = given.frame.rig.tolerance.property or PROPERTY
    return (share * np.abs(given.centre) / given.sd).ravel()


def tolerated(given: Problem) -> np.ndarray:
    """The smallest shift (n,) of each residual that matters, in sds of its noise.

    Positions and forces as [tolerance] has them; by default one sample's noise or SHARE of the smallest
    block's width and weight, whichever is more. Velocities matter as much as a sample's noise.
    """
    frame, there = given.frame, given.whitening.weight > 0
    stated = frame.rig.tolerance
    width, weight = (float(np.abs(given.centre[:, k]).min()) for k in (1, 0))
    noise = frame.arrays.sample
    out = np.empty_like(given.whitening.weight)
    for c, name in enumerate(CHANNELS):
        least = SAMPLES * noise[..., c]
        if name in ("x", "y", "distance", "offset"):
            least = stated.position or np.maximum(least, SHARE * width)
        elif name in ("fx", "fy", "grip", "shear"):
            least = stated.force or np.maximum(least, SHARE * weight)
        out[..., c] = least * given.whitening.weight[..., c]
    return out[there]
