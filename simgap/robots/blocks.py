"""Rows of a window that belong together, and by what they are correlated: noise, start, and discrepancies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Discrepancy:
    """`scale`: s by channel [unit / s^2, unit / s or unit]."""

    scale: Mapping[str, float]

    def __bool__(self) -> bool:
        return bool(self.scale)


NONE = Discrepancy({})


@dataclass(frozen=True)
class Source:
    """A discrepancy's covariance (k, k) at s = 1, or its variances (k,) where it ties no rows, and which rows
    of the block it is of (k,)."""

    rows: np.ndarray
    covariance: np.ndarray

    @property
    def trace(self) -> float:
        """The sum of its variances."""
        own = self.covariance
        return float(own.sum() if own.ndim == 1 else np.trace(own))

    def add(self, total: np.ndarray, variance: float) -> None:
        """Add it to a block's covariance, in place."""
        total[self._where] += variance * self.covariance

    @property
    def _where(self) -> tuple:
        if self.covariance.ndim == 1:
            return self.rows, self.rows
        first, end = int(self.rows[0]), int(self.rows[-1]) + 1
        if end - first == self.rows.size:  # rows ascend: a part of the matrix, which needs no copy
            return slice(first, end), slice(first, end)
        return self.rows[:, None], self.rows


@dataclass(frozen=True)
class Block:
    """Rows (n,) of one window that belong together: the noise's `variance` (n,), `start` (n, S) by which each
    state of the uncertain start moves them at one standard deviation, and sources of discrepancy by name;
    `repeats`: in how many logs the same motion is made."""

    rows: np.ndarray
    window: int
    variance: np.ndarray
    start: np.ndarray
    sources: Mapping[str, Source]
    repeats: int = 1

    def covariance(self, discrepancy: Discrepancy = NONE) -> np.ndarray:
        """The rows' covariance (n, n)."""
        out = np.diag(self.variance) + self.start @ self.start.T
        for name, s in discrepancy.scale.items():
            if name in self.sources:
                self.sources[name].add(out, s**2)
        return out
