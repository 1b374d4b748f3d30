"""First-order filters along the samples of a trial, exact for signals that are linear between samples."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def lowpass(values: np.ndarray, time: np.ndarray | float, step: float) -> np.ndarray:
    """First-order low-pass of (T, N, C) along N, starting at rest; linear between samples.

    `time` [s] is the time constant of all channels, or (C,).
    """
    ratio = step / np.maximum(time, 1e-4)
    keep = np.exp(-ratio)
    new, old = 1 - (1 - keep) / ratio, (1 - keep) / ratio - keep
    drive = np.empty_like(values)
    drive[:, 0], drive[:, 1:] = values[:, 0], new * values[:, 1:] + old * values[:, :-1]
    return faded(drive, ratio)


def faded(drive: np.ndarray, ratio: np.ndarray | float) -> np.ndarray:
    """y[k] = exp(-ratio) y[k-1] + drive[k] of (T, N, C) along N; `ratio` is that of all channels, or (C,)."""
    keep = np.exp(-np.asarray(ratio, float))
    if not keep.ndim:
        return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=1))
    each = (lfilter([1.0], [1.0, -k], drive[..., c], axis=1) for c, k in enumerate(keep))
    return np.stack([*each], -1)
