"""Boundary emissions: what the channels do around a boundary, learned from labelled trials.

A labelled boundary often lies at a fixed lag from what the channels show (a controller switches,
contact follows). For every boundary the course of all channels in a window around it, without the
window's mean, is compared with what such windows look like anywhere: a log-likelihood ratio per
candidate time, added to the log weight of advancing. Nothing in it knows the time of day or the
time since the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.sequence.emissions import DOF

PRIOR_COUNT = 2.0  # prior: weight of the channel's own pooled spread against that of each lag
LEAST_SPREAD = 0.05  # chosen: of a window's usual spread: labels are no better aligned than that


@dataclass(frozen=True)
class Detectors:
    """Templates of all boundaries; windows have `2 * half` cells.

    `mean`, `spread` (num_boundaries, 2 * half, num_channels), `usual` (num_channels,) the spread of
    windows anywhere; `jitter` (num_boundaries,) [cells] how much more than their posterior says
    held-out labels scatter; `weight` multiplies the log-likelihood ratio (neighbouring cells and
    channels are not independent), `state_weight` the state emissions beside it.
    """

    half: int
    mean: np.ndarray
    spread: np.ndarray
    usual: np.ndarray
    jitter: np.ndarray
    weight: float = 0.0
    state_weight: float = 1.0

    def log_ratios(self, values: np.ndarray) -> np.ndarray:
        """Unweighted log-likelihood ratios (num_cells - 1, num_boundaries), one a cell edge."""
        windows = _windows(values, self.half)
        log_far = _log_density(windows, self.usual)
        return np.stack([
            np.nansum(_log_density(windows - mean, spread) - log_far, axis=(1, 2))
            for mean, spread in zip(self.mean, self.spread, strict=True)
        ], axis=1)  # fmt: skip


def _log_density(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Student t, without its constant."""
    return -(DOF + 1) / 2 * np.log1p((x / scale) ** 2 / DOF) - np.log(scale)


def _windows(values: np.ndarray, half: int) -> np.ndarray:
    """Windows (num_cells - 1, 2 * half, num_channels) around every edge, mean removed; NaN outside."""
    gap = np.full((half - 1, values.shape[1]), np.nan)
    padded = np.concatenate([gap, values, gap])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half, axis=0).swapaxes(1, 2)
    known = np.isfinite(windows)
    mean = np.where(known, windows, 0.0).sum(1) / np.maximum(known.sum(1), 1)
    return windows - mean[:, None]


def learn(trials: Sequence[np.ndarray], edges: Sequence[np.ndarray], half: int) -> Detectors:
    """Templates from channels [(num_cells, num_channels), ...] and labelled edges.

    `edges[i][b]` is the index of the edge (between the cells of that index and the next) at
    boundary b of trial i; -1 where the boundary shows nothing of its own (a skipped subtask). A
    boundary that no trial shows has ratio 0 everywhere.
    """
    windows = [_windows(values, half) for values in trials]
    usual = np.sqrt(np.nanmean(np.vstack(windows) ** 2, axis=(0, 1)))
    usual = np.maximum(np.nan_to_num(usual), 1e-6)
    near = np.stack([w[np.clip(e, 0, len(w) - 1)] for w, e in zip(windows, edges, strict=True)])
    near[np.stack(edges) < 0] = np.nan
    known = np.isfinite(near)
    count = known.sum(0)
    filled = np.where(known, near, 0.0)
    mean = filled.sum(0) / np.maximum(count, 1)
    square = (known * (filled - mean) ** 2).sum(0)
    pooled = square.sum(1, keepdims=True) / np.maximum(count.sum(1, keepdims=True), 1)
    spread = (square + PRIOR_COUNT * pooled) / (count + PRIOR_COUNT) * (1 + 1 / np.maximum(count, 1))
    spread = np.where(count > 0, np.sqrt(spread) + LEAST_SPREAD * usual, usual)
    return Detectors(half, mean, spread, usual, np.zeros(len(mean)))
