"""Forces rounded to a step: the step, and the part of the rounding errors that a recording itself shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import root_scalar

from hmmseg.robust import runs

REPEATED = 0.5  # chosen: share of repeated values above which they lie on a lattice
BENT = 2.01  # physics: second differences of rounding errors reach twice the step
FEWEST = 5  # numerics: samples of a course
STIFFNESS = (-6.0, 10.0)  # numerics: decimal logarithms of the weights of squared second differences


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
    """What forces (N, 4) [N] differ from smooth ones that would be rounded to them; 0 where missing.

    The smoothest course whose distance from the readings is that of rounding errors, step / sqrt(12) in root
    mean square (Whittaker, Proc. Edinburgh Math. Soc. 41, 1922, with Morozov's discrepancy principle), within
    half a step of each. The error of a force that rests is the same throughout and does not show; courses end
    where a force bends by more than rounding can.
    """
    out = np.zeros_like(force)
    for k, read in enumerate(force.T):
        bend = np.abs(np.pad(np.diff(read, 2), 1))
        smooth = (bend[1:] < BENT * step) & (bend[:-1] < BENT * step) & np.isfinite(np.diff(read))
        for start, stop in runs(smooth):
            mine = read[start : stop + 1]
            if mine.size >= FEWEST and np.ptp(mine) > 0:
                out[start : stop + 1, k] = mine - np.clip(
                    _smoothed(mine, step), mine - step / 2, mine + step / 2
                )
    return out


def _smoothed(read: np.ndarray, step: float) -> np.ndarray:
    """The smoothest course (n,) by second differences that is step / sqrt(12) from the readings (n,)."""
    n, level = read.size, float(read.mean())
    bands = np.zeros((3, n))  # of the squared second differences, upper form
    bands[0, 2:] = 1.0
    bands[1, 1:] = np.r_[-2.0, np.full(n - 3, -4.0), -2.0]
    bands[2] = np.r_[1.0, 5.0, np.full(n - 4, 6.0), 5.0, 1.0]
    unit = np.zeros_like(bands)
    unit[2] = 1.0

    def course(stiffness: float) -> np.ndarray:
        return level + solveh_banded(unit + 10.0**stiffness * bands, read - level)

    def excess(stiffness: float) -> float:
        return float(np.mean(np.square(read - course(stiffness))) - step**2 / 12)

    low, high = STIFFNESS
    if excess(high) <= 0:
        return course(high)
    return course(root_scalar(excess, bracket=STIFFNESS, xtol=0.05).root if excess(low) < 0 else low)
