"""Blocks that hang askew in a hand that rolls: one corner meets the ground before their middle would."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, block_offset, corner_drop
from hmmseg.hand.roll import slow_roll
from hmmseg.hand.signals import Signals
from hmmseg.levels import DRIFTS


def tilts(
    s: Signals, pads: Pads, ends: Sequence[tuple[float, float]], steps: Sequence[Subtask]
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Of each carry its samples (num_timesteps,) and, on them, the block's tilt [rad], and its error [rad].

    Against how it stood when it was gripped: as the recorded roll of the hand says, else as the pads'
    places on the block show, of fingers that are one gripper's. `ends` (num_subtasks, 2) [s]: first and last
    time of every subtask.
    """
    if s.roll is None and not s.coupled:  # a block slips along one finger and stays upright
        return
    offset = block_offset(s.offset, s.fy1, s.fy2, pads)
    for before, step in pairwise(steps):
        start, end = ends[step.index]
        lift = ends[before.index][1]
        inside = (s.t >= start) & (s.t <= end)
        stood = (s.t > lift - DRIFTS) & (s.t <= lift)
        if (before.state, step.state) != (ON_GROUND, ABOVE_GROUND) or not inside.any():
            continue
        shown = offset if s.roll is None else s.roll
        stood &= np.isfinite(shown)
        if not stood.any():
            continue
        change = shown[inside] - np.median(shown[stood])
        if s.roll is not None:
            yield inside, change, 0.0
        else:
            yield inside, *slow_roll(s.t[inside], change, s.distance[inside])


def corner_drops(
    s: Signals, pads: Pads, ends: Sequence[tuple[float, float]], steps: Sequence[Subtask]
) -> tuple[np.ndarray, float]:
    """How far the lowest corner of what is carried lies below its base's middle (num_timesteps,) [m], and sd.

    After a landing as at its moment, until the block stands flat.
    """
    out, worst = np.zeros(s.t.size), 0.0
    for inside, tilt, sd in tilts(s, pads, ends, steps):
        there = s.distance[inside][np.isfinite(s.distance[inside])]
        if not there.size:
            continue
        width = float(np.median(there))
        out[inside] = np.nan_to_num(corner_drop(width, tilt))
        last = np.flatnonzero(inside)[-1]
        following = np.flatnonzero(s.t <= s.t[last] + DRIFTS)
        out[last + 1 : following[-1] + 1] = out[last]
        worst = max(worst, float(corner_drop(width, sd)))
    return out, worst
