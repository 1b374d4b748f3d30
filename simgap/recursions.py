"""Recursions over the samples of a channel, compiled; to be imported late, as numba takes half a second."""

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
