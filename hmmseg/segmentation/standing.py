"""Fingers that stand on the ground, or close on anything that the task does not name.

A pad that holds a block by its side passes on at most its friction: |fy| <= mu |fx| (Coulomb). A finger that
pushes down harder than that stands on something. Fingers that both press while they are farther apart than
their block is wide have something else between them.
"""

from __future__ import annotations

import numpy as np

from hmmseg.levels import MOVED, SURE
from hmmseg.robust import robust_sd

FRICTION = 1.5  # cited: rubber on dry solids reaches about 1 to 1.4 (Persson, J. Chem. Phys. 115, 2001)
CLEAR = 6.0  # numerics: standard deviations, so that no noise of an hour at 1 kHz is taken for a touch
BRIEF = 0.05  # physics: s; an impact of hard parts rings no longer


def standing(t: np.ndarray, force: np.ndarray, sd_force: float, free: np.ndarray) -> np.ndarray:
    """Booleans (num_timesteps,): samples of stretches in which a finger stands on something.

    `force` (num_timesteps, 4): fx1, fy1, fx2, fy2 [N] at t [s]; `sd_force`: their noise, NaN if not stated.
    `free` (num_timesteps,) marks free motion: offsets and spread of the vertical forces are learned there.
    """
    out = np.zeros(t.size, bool)
    for across, along in (force[:, :2].T, force[:, 2:].T):
        rest = along[free & np.isfinite(along)]
        centre = float(np.median(rest)) if rest.size else 0.0
        spread = robust_sd(rest - centre) if rest.size else 0.0
        limit = FRICTION * np.abs(np.nan_to_num(across)) + CLEAR * max(spread, float(np.nan_to_num(sd_force)))
        out |= _lasting(centre - np.nan_to_num(along, nan=np.inf) > limit, t)
    return out


def astride(
    t: np.ndarray, press: np.ndarray, apart: np.ndarray, sd_force: float, width: float, touch: float
) -> tuple[float, float] | None:
    """When fingers that close on a block first had something wider between them [s], and how wide [m] it was.

    None where nothing was. `press` (num_timesteps, 2): what each finger presses inwards with [N] at t [s],
    `sd_force` its noise; `apart` (num_timesteps,): width [m] of what is between them, if anything. The block
    is `width` [m] wide and is touched at `touch` [s]. Fingers that press no more for longer than an impact
    have let go meanwhile: what they did before belongs to no closing.
    """
    pressed = press > SURE * sd_force
    n = int(np.searchsorted(t, touch))
    any_pressed = np.flatnonzero(pressed[:n].any(axis=1))
    last, first = touch, n
    for i in any_pressed[::-1]:
        if last - t[i] > BRIEF:
            break
        first, last = int(i), float(t[i])
    found = np.flatnonzero(pressed[first:n].all(axis=1) & (apart[first:n] > width + MOVED))
    return (float(t[first + found[0]]), float(apart[first + found[0]])) if found.size else None


def _lasting(found: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Those stretches of `found` that last longer than an impact."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], found, [False]])))
    out = np.zeros_like(found)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        out[start:stop] = stop - start > 1 and t[stop - 1] - t[start] >= BRIEF
    return out
