"""Hands that roll: the fingers of one gripper, and what they hold, turn together about their middle.

Given as the column `hand_roll` [rad] (counterclockwise, 0 where the fingers are level), a roll is taken out
of the recording as it is read, for all stages alike: what the fingers differ by is turned back, their mean
position and the sum of their forces stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.contact.equations import turned
from hmmseg.errors import InputError
from hmmseg.io.trial import ROLL, Trial
from hmmseg.robust import bridged

MOST = 0.5  # limit: rad; a hand rolled further holds no upright block (and degrees are larger)


def levelled(trial: Trial) -> Trial:
    """A Cartesian trial as its fingers would have recorded it had the hand not rolled.

    InputError for a roll that no hand which holds an upright block has.
    """
    if ROLL not in trial.channels:
        return trial
    roll = trial.channels[ROLL]
    beyond = np.flatnonzero(np.abs(np.nan_to_num(roll)) > MOST)
    if beyond.size:
        where = f"{trial.file}: sample {beyond[0] + 1}, column {ROLL}"
        expected = f"radians, 0 where the fingers are level, at most {MOST:g} either way (is it in degrees?)"
        raise InputError(where, f"{roll[beyond[0]]:.3g} rad", expected)
    roll = bridged(roll, trial.t)
    c = dict(trial.channels)
    pace = np.gradient(roll, trial.t)
    level: tuple[np.ndarray, np.ndarray] | None = None
    for kind in ("", "v", "f"):
        names = [[f"{kind}{axis}{i}" for axis in "xy"] for i in (1, 2)]
        if not all(name in c for pair in names for name in pair):
            continue
        (x1, y1), (x2, y2) = ((c[x], c[y]) for x, y in names)
        across, up = turned(x2 - x1, y2 - y1, -roll)
        if kind == "":
            level = across, up
        if kind == "v" and level is not None:  # of a frame that turns
            across, up = across + pace * level[1], up - pace * level[0]
        for sign, (x, y) in zip((-0.5, 0.5), names, strict=True):
            c[x], c[y] = (x1 + x2) / 2 + sign * across, (y1 + y2) / 2 + sign * up
    return replace(trial, channels=c)


def level_row(row: np.ndarray, roll: float) -> np.ndarray:
    """One row (12,) of CARTESIAN_CHANNELS as it would be had the hand not rolled by so much [rad].

    Velocities are turned as they are: what a turning frame adds only makes the fingers differ.
    """
    first, second = row.reshape(2, 3, 2)  # of positions, velocities and forces: across, up
    across, up = turned(second[:, 0] - first[:, 0], second[:, 1] - first[:, 1], -roll)
    half = np.stack([across, up], axis=1) / 2
    middle = (first + second) / 2
    return np.concatenate([middle - half, middle + half]).ravel()
