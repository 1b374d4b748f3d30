"""The least of a quadratic within bounds: the one solver that fits and weighs effects."""

from __future__ import annotations

import numpy as np

ROUNDING = 1e-12  # numerics: of the largest pull: a smaller slope draws nowhere
PATIENCE = 3  # numerics: exchanges of many coordinates that do not help before one at a time is exchanged


def least(
    matrix: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The x (n,) within [low, high] at which x' matrix x / 2 - pull x is least, and which are held (n,).

    `matrix` (n, n) is positive definite, so there is one. By block principal pivoting: coordinates past a
    bound are held there, held ones that the slope draws inwards are released, all at once while that leaves
    fewer of them, else the last one alone (Judice & Pires, Comput. Oper. Res. 21, 1994).
    """
    x, side = np.linalg.solve(matrix, pull), np.zeros(pull.size, int)  # side: -1 held low, 1 held high
    slope, fewest, patience = np.zeros_like(x), pull.size + 1, PATIENCE
    nothing = ROUNDING * np.abs(pull).max(initial=0.0)
    while True:
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
