"""Minimum of a quadratic within bounds: the solver that fits and weighs effects."""

from __future__ import annotations

import numpy as np

ROUNDING = 1e-12  # numerics: slopes below this share of the largest pull count as zero
PATIENCE = 3  # numerics: exchanges of many coordinates without progress before one is exchanged at a time
MOST = 1000  # limit: exchanges, which rounding may repeat for ever


def least(
    matrix: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The x (n,) within [low, high] that minimises x' matrix x / 2 - pull x, and whether each is at a bound
    (n,).

    `matrix` (n, n) is positive definite, so the minimum is unique. Block principal pivoting: coordinates
    beyond a bound are fixed there and fixed ones that the slope draws inwards are released, all at once while
    their number decreases, else the last one alone (Judice & Pires, Comput. Oper. Res. 21, 1994).

    Raises:
        LinAlgError: `matrix` is not positive definite, or only just.
    """
    x, side = np.linalg.solve(matrix, pull), np.zeros(pull.size, int)  # side: -1 fixed low, 1 fixed high
    slope, fewest, patience = np.zeros_like(x), pull.size + 1, PATIENCE
    nothing = ROUNDING * np.abs(pull).max(initial=0.0)
    for _ in range(MOST):
        new = np.where(side == 0, np.where(x < low, -1, np.where(x > high, 1, 0)), side)
        new[(side != 0) & (side * slope > nothing)] = 0
        wrong = np.flatnonzero(new != side)
        if not wrong.size:
            return x, side != 0
        if wrong.size < fewest:
            fewest, patience = wrong.size, PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        side[wrong] = new[wrong]
        free = side == 0
        x = np.where(side < 0, low, np.where(side > 0, high, 0.0))
        rest = pull[free] - matrix[np.ix_(free, ~free)] @ x[~free]
        x[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
        slope = np.where(free, 0.0, matrix @ x - pull)
    raise np.linalg.LinAlgError("not positive definite")
