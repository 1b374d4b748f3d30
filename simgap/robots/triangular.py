"""Triangular factors by LAPACK itself: of many small matrices, most of the time would go into checks."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import lapack

dpotrf: Any = lapack.dpotrf  # type: ignore[attr-defined]
dtrtrs: Any = lapack.dtrtrs  # type: ignore[attr-defined]
dpotri: Any = lapack.dpotri  # type: ignore[attr-defined]  # inverse from a Cholesky factor

LARGE = 48  # numerics: rows from which on one matrix at a time is faster


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


def all_solved_by(factors: np.ndarray, columns: np.ndarray, transposed: bool = False) -> np.ndarray:
    """`solved_by` of many factors (P, n, n) and their columns (P, n, k)."""
    if factors.shape[-1] >= LARGE:
        each = zip(factors, columns, strict=True)
        return np.stack([solved_by(factor, mine, transposed) for factor, mine in each])
    return np.linalg.solve(factors.transpose(0, 2, 1) if transposed else factors, columns)


def all_inverses(factors: np.ndarray) -> np.ndarray:
    """Inverses (P, n, n) of L L' of lower factors L (P, n, n)."""
    if factors.shape[-1] < LARGE:
        half = np.linalg.inv(factors)
        return np.matmul(half.transpose(0, 2, 1), half)
    out = np.stack([dpotri(factor, lower=1)[0] for factor in factors])  # the lower half
    out += out.transpose(0, 2, 1)
    diagonal = np.einsum("pii->pi", out)  # a view
    diagonal *= 0.5
    return out
