"""Optimal partition of one recording into a given number of stretches: where EM starts.

Dynamic programming over all partitions (Jackson et al., IEEE Signal Process. Lett. 12, 2005) with a
Gaussian cost per stretch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MAX_BLOCKS = 250  # numerics: the cost table is quadratic in it


def partition(
    values: np.ndarray, num_stretches: int, floor: float, cuts: Sequence[int] | np.ndarray = ()
) -> np.ndarray:
    """Path (num_cells,) of stretch numbers 0 .. num_stretches - 1 of least total cost.

    A stretch of n blocks costs n/2 log(variance + floor^2) per column of `values` (num_cells,
    num_features), which must be finite; none goes on across the cells `cuts`. ValueError where there are
    fewer cells than stretches.
    """
    num_cells = len(values)
    if num_cells < num_stretches:
        raise ValueError(f"{num_cells} cells, expected at least {num_stretches}")
    edges = np.linspace(0, num_cells, min(num_cells, MAX_BLOCKS) + 1).round().astype(int)
    edges = np.unique(np.concatenate([edges, np.asarray(cuts, int)]))
    means = np.add.reduceat(values, edges[:-1], axis=0) / np.diff(edges)[:, None]
    cost = _costs(means, floor)
    for at in np.searchsorted(edges, cuts):
        cost[:at, at + 1 :] = np.inf
    best, sources = cost[0].copy(), []
    for _ in range(num_stretches - 1):
        total = best[:, None] + cost
        sources.append(total.argmin(0))
        best = total.min(0)
    found, end = [], len(means)
    for source in reversed(sources):
        end = int(source[end])
        found.append(edges[end])
    return np.searchsorted(np.array(found[::-1]), np.arange(num_cells), side="right")


def _costs(means: np.ndarray, floor: float) -> np.ndarray:
    """Cost [a, b] of the stretch of blocks a <= i < b, inf where it is empty."""
    num_blocks = len(means)
    index = np.arange(num_blocks + 1)
    length = (index[None] - index[:, None]).astype(float)
    count = np.where(length > 0, length, 1.0)
    cost = np.zeros_like(length)
    for column in (means - means.mean(0)).T:
        first = np.concatenate([[0.0], np.cumsum(column)])
        second = np.concatenate([[0.0], np.cumsum(column**2)])
        mean = (first[None] - first[:, None]) / count
        variance = np.maximum((second[None] - second[:, None]) / count - mean**2, 0.0)
        cost += count / 2 * np.log(variance + floor**2)
    return np.where(length > 0, cost, np.inf)
