"""Where the gap lies: excess of squares by trial, channel, part and band, false discoveries controlled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, false_discovery_control, norm

from simgap.attribution.problem import Rows

RATE = 0.05  # chosen: share of false discoveries among the cells that are listed


@dataclass(frozen=True)
class Cell:
    """One cell that shows a gap: its `share` of the excess square, and its excess as a normal score `z`."""

    trial: str
    channel: str
    part: str
    band: tuple[float, float]
    share: float
    z: float


def tallied(
    rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers (c,), squares in units of the noise (c,) and counts (c,) of the cells with each a band.

    `left` (n,): cosine coefficients of a residual; `noise` (n,): their standard deviation.
    """
    key, inverse = np.unique(rows.cell * len(rows.bands) + band, return_inverse=True)
    square = (left / noise) ** 2
    return key, np.bincount(inverse, square), np.bincount(inverse).astype(float)


def _step(rows: Rows) -> float:
    """Usual time [s] from row to row of a cell; infinite where no cell has two."""
    order = np.argsort(rows.cell, kind="stable")
    step = np.diff(rows.time[order])[np.diff(rows.cell[order]) == 0]
    return float(np.median(step)) if step.size else np.inf


def significant(rows: Rows, band: np.ndarray, left: np.ndarray, noise: np.ndarray) -> tuple[Cell, ...]:
    """Cells whose squares exceed the noise's, largest share first (Benjamini & Hochberg, JRSS B 57, 1995)."""
    key, energy, count = tallied(rows, band, left, noise)
    chance = chi2.sf(energy, count)
    listed = np.flatnonzero(false_discovery_control(np.clip(chance, 0, 1), method="bh") < RATE)
    excess = np.maximum(energy - count, 0.0)
    total = max(float(excess[listed].sum()), 1e-12)
    edges = (*rows.bands, 0.5 / _step(rows))
    out = []
    for at in listed:
        cell, b = divmod(int(key[at]), len(rows.bands))
        cell, part = divmod(cell, len(rows.parts))
        trial, channel = divmod(cell, len(rows.channels))
        # log sf keeps what is far beyond the smallest number
        z = float(norm.isf(chance[at])) if chance[at] > 1e-300 else float(np.sqrt(2 * excess[at] / 2 + 37**2))
        out.append(Cell(rows.trials[trial], rows.channels[channel], rows.parts[part],
                        (edges[b], edges[b + 1]), float(excess[at]) / total, z))  # fmt: skip
    return tuple(sorted(out, key=lambda c: -c.share))
