"""The one way in which readings are made fewer: means of neighbouring samples."""

from __future__ import annotations

import numpy as np


def group_size(rate: float, max_rate: float) -> int:
    """How many samples at `rate` [Hz] become one at no more than `max_rate`."""
    return int(np.ceil(rate / max_rate - 1e-6))


def grouped(values: np.ndarray, group: int, width: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Means (M, ...) over each `group` of samples of values (N, ...), and how many values each is of.

    Of a group only the first `width` samples count, all by default; what is left over at the end is left out,
    and a mean of nothing is NaN.
    """
    width = group if width is None else width
    starts = np.arange(0, len(values) - width + 1, group)
    block = values[starts[:, None] + np.arange(width)]
    there = np.isfinite(block)
    count = there.sum(axis=1)
    mean = np.where(there, block, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan), count
