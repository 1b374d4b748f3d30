"""How loud a recording's noise is and how it is coloured, learned where nothing but noise is expected.

A velocity's residual averages three samples of velocity and differences three of position, so its noise is
not white: at low frequency it holds (4 + 2 cos w)^2 / 36 of the velocity's density and sin(w)^2 of the
position's. Beyond that sensors of one kind may be louder than stated and remember their last error (AR(1)).
Level and colour of each kind are the likeliest for the median squares of some frequency bands: free motion
for forces, hands at rest for velocities, grips for positions. Medians do not see what an effect does in
places.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgap.attribution.background import STATED
from simgap.attribution.problem import Rows, cosines
from simgap.gap.problem import Problem
from simgap.gap.trial_arrays import CHANNELS
from simgap.gap.unresolved import MEDIAN
from simgap.phases import Phase

KINDS = (("x", "y", "distance", "offset"), ("vx", "vy"), ("fx", "fy", "grip", "shear"))
LEVELS = np.linspace(0.6, 1.5, 37)  # prior: noise over the stated one; beyond that it is an effect
COLOURS = np.linspace(0.0, 0.4, 9)  # prior: correlation from sample to sample; more is an effect
BANDS = 6  # numerics: of which medians are taken
SLOWEST = 1.0  # chosen: Hz; what is slower says more of effects than of noise
OUTLIER = 8.0  # chosen: nats that a band costs at most: an effect may fill it
FEWEST = 12  # numerics: coefficients of a band
CLEAN = 1.25  # numerics: variance of residuals over that of noise alone, beyond which they tell nothing of it


def with_noise(given: Problem, rows: Rows, residual: np.ndarray) -> Rows:
    """The rows with the noise's standard deviation in each cosine coefficient of their cells, in units of the
    stated noise, and with the shape of white noise there."""
    turn, frequency = _places(rows)
    shape = _shape(given, rows, turn)
    square = cosines(rows, residual[:, None])[0][:, 0] ** 2 / shape
    arrays = given.frame.arrays
    there = given.whitening.weight > 0
    doubt = np.square(arrays.sd[there] / arrays.plain[there])
    sure = (np.bincount(rows.cell, doubt) < CLEAN * np.bincount(rows.cell))[rows.cell]
    phase = arrays.phase.argmax(-1)[..., None].repeat(len(CHANNELS), -1)[there]
    quiet = (None, (Phase.PICKUP, Phase.PLACE), (Phase.FREE,))
    variance = shape.copy()
    for names, at in zip(KINDS, quiet, strict=True):
        mine = np.isin(rows.channel, [CHANNELS.index(n) for n in names])
        seen = mine & sure & (frequency > SLOWEST) & (True if at is None else np.isin(phase, at))
        level, colour = _likeliest(turn[seen], square[seen])
        variance[mine] *= level**2 * _density(turn[mine], colour)
    return replace(rows, sd=np.sqrt(variance), shape=shape)


def _places(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Of each coefficient (n,): radians from sample to sample, and frequency [Hz]."""
    turn, frequency = np.zeros(rows.cell.size), np.zeros(rows.cell.size)
    order = np.argsort(rows.cell, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(rows.cell[order])) + 1):
        turn[mine] = np.pi * np.arange(mine.size) / mine.size
        if mine.size > 1:
            frequency[mine] = turn[mine] / (2 * np.pi * np.median(np.diff(rows.time[mine])))
    return turn, frequency


def _shape(given: Problem, rows: Rows, turn: np.ndarray) -> np.ndarray:
    """Density (n,) of the residual's stated noise over white noise's of the same variance."""
    arrays, t = given.frame.arrays, given.frame.world.t
    step = float(np.median(np.diff(t[0])))
    out = np.ones(turn.size)
    for place, speed in (("x", "vx"), ("y", "vy")):
        p, v = (arrays.sample[..., CHANNELS.index(n)] for n in (place, speed))
        shaken = float(np.median(np.square(p / step) / np.square(v)))
        mine = rows.channel == CHANNELS.index(speed)
        w = turn[mine]
        out[mine] = 2 * (np.square((4 + 2 * np.cos(w)) / 6) + shaken * np.square(np.sin(w))) / (1 + shaken)
    return np.maximum(out, 0.02)


def _density(turn: np.ndarray | float, colour: float | np.ndarray) -> np.ndarray:
    """Spectral density of AR(1) noise of unit variance."""
    return (1 - colour**2) / (1 - 2 * colour * np.cos(turn) + colour**2)


def _likeliest(turn: np.ndarray, square: np.ndarray) -> tuple[float, float]:
    """Level and colour of coefficients at `turn` with these squares."""
    at = np.minimum((turn / np.pi * BANDS).astype(int), BANDS - 1)
    score = -0.5 * np.square(2 * np.log(LEVELS)[:, None] / STATED) + np.zeros(COLOURS.size)
    for band in range(BANDS):
        mine = at == band
        if mine.sum() < FEWEST:
            continue
        seen = np.log(max(float(np.median(square[mine])) / MEDIAN, 1e-9))
        expected = 2 * np.log(LEVELS)[:, None] + np.log(_density(float(np.mean(turn[mine])), COLOURS))
        # The median of n squares is off by 2.33 / sqrt(n) of itself.
        score = score - np.minimum(0.5 * np.square(seen - expected) * mine.sum() / 2.33**2, OUTLIER)
    level, colour = np.unravel_index(int(score.argmax()), score.shape)
    return float(LEVELS[level]), float(COLOURS[colour])
