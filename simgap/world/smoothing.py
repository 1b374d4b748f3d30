"""Smooth finger motions from noisy samples of position and velocity.

Position noise of 0.02 mm is 0.1 N through a foam pad, several times the force sensor's noise, so
a replay is driven by the smoothed motion. Fingers rest for seconds and stop within milliseconds
where they touch: every sample takes a local parabola, fitted to positions and velocities, over
the widest window (before, after or around it) that the data do not refute. This is Lepski's
choice of bandwidth by tests (Goldenshluger & Nemirovski, Math. Meth. Statist. 6, 1997).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

REACHES = (1, 2, 3, 4, 6, 8, 12, 16, 24)  # numerics: samples on a side
TOLERANCE = 1.2  # prior: standard deviation allowed over the sensors': a held finger still trembles
LEVEL = 0.1  # chosen: of the test that refutes a window
AGREEMENT = 1.5  # chosen: standard deviations within which a wider window must agree with the narrower ones


@dataclass(frozen=True)
class Motion:
    """Smoothed motion of several axes at times `t` (T,) [s].

    `position`, `velocity` (T, axes) [m, m/s]; `sd` (T, axes) [m] of the position, inf where a hole in
    the samples was only bridged.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    sd: np.ndarray

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (len(times), axes): cubic between samples, at rest beyond them."""
        inside = np.clip(times, self.t[0], self.t[-1])
        k = np.clip(np.searchsorted(self.t, inside, side="right") - 1, 0, len(self.t) - 2)
        length = (self.t[k + 1] - self.t[k])[:, None]
        s = (inside - self.t[k])[:, None] / length
        way = self.position[k + 1] - self.position[k]
        v0, v1 = length * self.velocity[k], length * self.velocity[k + 1]
        square, cube = 3 * way - 2 * v0 - v1, v0 + v1 - 2 * way
        position = self.position[k] + s * (v0 + s * (square + s * cube))
        velocity = (v0 + s * (2 * square + 3 * s * cube)) / length
        return position, np.where((times == inside)[:, None], velocity, 0.0)


def smooth(t: np.ndarray, position: np.ndarray, velocity: np.ndarray, sd_position: np.ndarray,
           sd_velocity: np.ndarray) -> Motion:  # fmt: skip
    """Motion from samples (T, axes) of position [m] and velocity [m/s], NaN where missing.

    `sd_*` (T, axes) are one sample's noise.
    """
    weights = [np.where(np.isfinite(z), 1.0 / (TOLERANCE * sd), 0.0)
               for z, sd in ((position, sd_position), (velocity, sd_velocity))]  # fmt: skip
    samples = [np.nan_to_num(position), np.nan_to_num(velocity)]
    sides = ((1, 1), (1, 0), (0, 1))
    best, _ = _windows(t, samples, weights, 1, 1)  # position, velocity, variance of the position
    low, high = (np.full(position.shape, sign * np.inf) for sign in (-1, 1))
    growing = np.ones((len(sides), *position.shape), bool)
    for reach in REACHES:
        for k, (before, after) in enumerate(sides):
            found, fits = _windows(t, samples, weights, reach * before, reach * after)
            width = AGREEMENT * np.sqrt(found[..., 2])
            agrees = (found[..., 0] >= low) & (found[..., 0] <= high)
            growing[k] &= fits & agrees
            low = np.where(growing[k], np.maximum(low, found[..., 0] - width), low)
            high = np.where(growing[k], np.minimum(high, found[..., 0] + width), high)
            better = growing[k] & (found[..., 2] < best[..., 2])
            best[better] = found[better]
    for axis in range(best.shape[1]):  # holes wider than any window
        there = np.isfinite(best[:, axis, 2])
        for part in (0, 1):
            best[:, axis, part] = np.interp(t, t[there], best[there, axis, part])
    return Motion(t, best[..., 0], best[..., 1], np.sqrt(best[..., 2]) / TOLERANCE)


def _windows(t: np.ndarray, samples: list[np.ndarray], weights: list[np.ndarray], before: int,
             after: int) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Parabolas about every sample over so many samples before and after it.

    Position, velocity and variance (T, axes, 3) of each, and (T, axes) whether the data allow it.
    A window of one neighbour is always allowed: there is nothing to fall back on.
    """
    n = t.size
    rows = np.arange(n)[:, None] + np.arange(-before, after + 1)
    inside = (rows >= 0) & (rows < n)
    rows = np.clip(rows, 0, n - 1)
    unit = np.median(np.diff(t))
    s = (t[rows] - t[:, None]) / unit
    ones, zeros = np.ones_like(s), np.zeros_like(s)
    designs = [np.stack([ones, s, s**2], -1), np.stack([zeros, ones, 2 * s], -1) / unit]
    shape = samples[0].shape
    normal, right = np.zeros((*shape, 3, 3)), np.zeros((*shape, 3))
    square, count = np.zeros(shape), np.zeros(shape)
    for design, values, weight in zip(designs, samples, weights, strict=True):
        w = (weight[rows] * inside[..., None]) ** 2  # (T, window, axes)
        y = values[rows] - (samples[0][:, None] if design is designs[0] else 0.0)
        normal = normal + np.einsum("twa,twi,twj->taij", w, design, design)
        right = right + np.einsum("twa,twi,twa->tai", w, design, y)
        square = square + (w * y**2).sum(1)
        count = count + (w > 0).sum(1)
    proper = np.isfinite(np.linalg.cond(normal)) & (np.linalg.cond(normal) < 1e12) & (count >= 3)
    normal = np.where(proper[..., None, None], normal, np.eye(3))
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    left = np.maximum(square - (solution * right).sum(-1), 0.0)
    freedom = count - 3
    fits = proper & ((freedom <= 0) | (left <= 2 * gammaincinv(np.maximum(freedom, 1) / 2, 1 - LEVEL)))
    if before + after <= 2:
        fits = proper
    variance = np.where(proper, np.linalg.inv(normal)[..., 0, 0], np.inf)
    return np.stack([solution[..., 0] + samples[0], solution[..., 1] / unit, variance], -1), fits
