"""Linear unknowns with a normal prior, integrated out of a least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Nuisances:
    """Columns (n, Z) of whitened residuals, each per its standard deviation beforehand."""

    columns: np.ndarray

    @cached_property
    def _basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal directions (n, R), and what share (R,) of a square along each they take away."""
        bend = self.columns.T @ self.columns
        square, turn = np.linalg.eigh(bend)
        kept = square > 1e-9 * max(float(square.max(initial=0.0)), 1e-9)
        return self.columns @ (turn[:, kept] / np.sqrt(square[kept])), square[kept] / (1 + square[kept])

    def product(self, a: np.ndarray, b: np.ndarray) -> Any:
        """a' (1 + columns columns')^-1 b of (n, ...) each: what nuisances may have made counts less."""
        basis, taken = self._basis
        mine, other = basis.T @ a, basis.T @ b
        return a.T @ b - (mine.T * taken) @ other

    def left(self, residual: np.ndarray) -> np.ndarray:
        """What they leave of a residual (n,), each at its likeliest value."""
        basis, taken = self._basis
        return residual - basis @ (taken * (basis.T @ residual))
