"""Forces rounded to a step: the step, and the part of the rounding errors that a recording itself shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

REPEATED = 0.5  # chosen: share of repeated values above which they lie on a lattice
TURNS = 200  # numerics: rounds of smoothing, after which errors slower than some twenty samples stay unseen


def rounding_step(forces: Sequence[np.ndarray]) -> float:
    """The step [N] of the lattice through zero on which forces (N, 4) of several trials lie; 0 without one.

    In files written to 1e-5 N one sample in ten repeats another's value by chance; on a lattice most do. The
    step is the median gap between neighbouring levels, refined on all samples.
    """
    read = np.concatenate([force.ravel() for force in forces])
    values = read[np.isfinite(read)]
    levels = np.unique(np.round(np.abs(values), 6))
    if 1 - levels.size / max(values.size, 1) < REPEATED or levels.size < 4:
        return 0.0
    step = float(np.median(np.diff(levels)))
    for reach in (4, 16, 64, 256):  # farther levels determine the step ever more precisely
        count = np.round(values / step)
        near = (np.abs(count) <= reach) & (count != 0)
        if near.any():
            step = float(values[near] @ count[near] / (count[near] @ count[near]))
    off = np.abs(values / step - np.round(values / step))
    return step if np.mean(off < 0.1) >= 0.9 else 0.0


def rounding_error(force: np.ndarray, step: float) -> np.ndarray:
    """What forces (N, 4) [N] differ from the smoothest ones that would be rounded to them; 0 where missing.

    The error of a force that rests is the same throughout and does not show, nor do errors where readings
    jump over a level. Smoothing and projection onto the readings' intervals alternate.
    """
    slow = np.abs(np.diff(force, axis=0)) < 1.5 * step
    smooth = force
    for _ in range(TURNS):
        flow = np.pad(np.where(slow, np.diff(smooth, axis=0), 0.0), ((1, 1), (0, 0)))
        smooth = np.clip(smooth + np.diff(flow, axis=0) / 4, force - step / 2, force + step / 2)
    return np.nan_to_num(force - smooth)
