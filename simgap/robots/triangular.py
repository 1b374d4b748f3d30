"""Triangular factors by LAPACK itself: of many small matrices, most of the time would go into checks."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import lapack

dpotrf: Any = lapack.dpotrf  # type: ignore[attr-defined]
dtrtrs: Any = lapack.dtrtrs  # type: ignore[attr-defined]


def factored(matrix: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor; LinAlgError where there is none."""
    factor, fault = dpotrf(matrix, lower=1, clean=1)
    if fault:
        raise np.linalg.LinAlgError("not positive definite")
    return factor


def solved_by(factor: np.ndarray, columns: np.ndarray, transposed: bool = False) -> np.ndarray:
    """L^-1 columns (n, k) of a lower factor L (n, n), or L'^-1 columns."""
    if not columns.size:
        return np.zeros(columns.shape)
    out, fault = dtrtrs(factor, columns, lower=1, trans=int(transposed))
    if fault:
        raise np.linalg.LinAlgError("singular")
    return out
