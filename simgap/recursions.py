"""Recursions over samples, compiled; to be imported late, as numba takes half a second."""

from __future__ import annotations

import numpy as np

from hmmseg.online.compiled import compiled


@compiled
def smoothed(t: np.ndarray, values: np.ndarray, tau: float, start: float) -> np.ndarray:
    """tau y' + y = u (num_timesteps,), linear between the times `t` of its samples, from a `start` on."""
    out = np.empty_like(values)
    out[0] = start
    for i in range(values.size - 1):
        step = t[i + 1] - t[i]
        late = tau * (values[i + 1] - values[i]) / step
        # On each piece y = u - tau slope + decaying rest.
        out[i + 1] = values[i + 1] - late + np.exp(-step / tau) * (out[i] - values[i] + late)
    return out


@compiled
def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only where that pushes a side of the gap."""
    out = np.empty_like(values)
    at = values[0]
    for i in range(values.size):
        if np.isfinite(values[i]):
            at = min(max(at, values[i] - width / 2), values[i] + width / 2)
        out[i] = at
    return out


@compiled
def recursion(keep: np.ndarray, drive: np.ndarray, start: np.ndarray) -> np.ndarray:
    """y[k] = keep[k] y[k-1] + drive[k] along the samples of T trials (T, N), from a `start` (T,) on."""
    out = np.empty_like(drive)
    for t in range(drive.shape[0]):
        y = start[t]
        for k in range(drive.shape[1]):
            y = keep[t, k] * y + drive[t, k]
            out[t, k] = y
    return out


@compiled
def innovations(
    values: np.ndarray, weight: np.ndarray, sd: np.ndarray, walk: np.ndarray, new: np.ndarray, anywhere: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a Kalman filter did not expect of values (T, N), and its variance over that of their noise `sd`.

    Its state walks with variances `walk`; where it is `new` it has the variance `anywhere`, and the first
    value that has weight sets it and tells nothing. Values of less `weight` (0 to 1) tell less.
    """
    out, factor = np.empty_like(values), np.empty_like(values)
    for t in range(values.shape[0]):
        place, variance, fresh = values[t, 0], anywhere, 1.0
        for k in range(values.shape[1]):
            variance += walk[t, k]
            if new[t, k]:
                variance, fresh = anywhere, 1.0
            w, noise = weight[t, k], sd[t, k] ** 2
            larger = 1 + w * variance / noise
            miss = values[t, k] - place
            place += w * variance / (noise * larger) * miss
            variance /= larger
            out[t, k], factor[t, k] = (1 - fresh) * w * miss, 1 + (1 - fresh) * (larger - 1)
            fresh *= 1 - w
    return out, factor
