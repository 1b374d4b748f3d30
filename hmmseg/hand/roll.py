"""Hands that roll: the fingers of one gripper, and what they hold, turn together about their middle.

Given as the column `hand_roll` [rad] (counterclockwise, 0 where the fingers are level), a roll is taken out
of the recording as it is read, for all stages alike: what the fingers differ by is turned back, their mean
position and the sum of their forces stay. Where it is not given, the block shows it: while held,
`block_offset` is constant but for a roll of hand and block.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.contact.equations import rolled_offset, turned
from hmmseg.errors import InputError
from hmmseg.hand.tool import smooth
from hmmseg.io.trial import ROLL, Trial
from hmmseg.robust import bridged

MOST = 0.5  # limit: rad; a hand rolled further holds no upright block (and degrees are larger)
SLOWEST = 0.25  # prior: s; a hand with a block turns no faster than 2 Hz (an arm's own modes lie above)


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
    return _turned_back(trial, bridged(roll, trial.t))


def _turned_back(trial: Trial, roll: np.ndarray) -> Trial:
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


def with_roll(trial: Trial, roll: np.ndarray) -> Trial:
    """The trial with a roll (num_timesteps,) [rad] that was found taken out and put among its channels."""
    return _turned_back(replace(trial, channels=trial.channels | {ROLL: roll}), roll)


def slow_roll(t: np.ndarray, offset: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, float]:
    """Roll (num_samples,) [rad] that a height difference of the pads' hold [m] shows, and its error.

    `t` [s], `offset` less its value while the block stood, `distance` of the fingers [m]: of one carry. Local
    parabolas over SLOWEST; what noise alone makes of them is shrunk away (positive-part, James and Stein).
    """
    there = np.isfinite(offset) & np.isfinite(distance)
    if there.sum() < 4:
        return np.zeros(t.size), 0.0
    raw = offset[there] / rolled_offset(distance[there], 1.0)
    slow = smooth(t[there], raw, window=SLOWEST)
    bend = np.diff(raw, 2)
    length = max(SLOWEST / float(np.median(np.diff(t[there]))), 3.0)
    # A local parabola's middle value has 9 / 4 of a mean's variance; its ends more, which are few.
    noise = float(np.sqrt(np.mean(bend**2) / 6 * min(2.25 / length, 1.0)))
    power = float(np.mean(slow**2))
    kept = max(0.0, 1 - noise**2 / power) if power > 0 else 0.0
    return np.interp(t, t[there], kept * slow), noise * kept
