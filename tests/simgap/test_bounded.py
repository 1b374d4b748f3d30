"""The one solver within bounds, beside SciPy's on random quadratics."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from simgap.bounded import least


def problem(seed, size=6, tight=1.0):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3 * size, size))
    matrix = factor.T @ factor + np.eye(size)
    pull = matrix @ rng.normal(size=size)
    return matrix, pull, -tight * rng.random(size), tight * rng.random(size)


@pytest.mark.parametrize("seed", range(20))
def test_no_better_point_within_bounds_and_none_that_scipy_finds(seed):
    matrix, pull, low, high = problem(seed)
    x, held = least(matrix, pull, low, high)
    factor = np.linalg.cholesky(matrix)
    theirs = lsq_linear(factor.T, np.linalg.solve(factor, pull), (low, high), method="bvls").x
    np.testing.assert_allclose(x, theirs, atol=1e-7)
    assert (x >= low).all() and (x <= high).all()
    slope = matrix @ x - pull
    assert np.abs(slope[~held]).max(initial=0.0) < 1e-9
    # At a bound going on would lead outside, or nothing would be gained by coming back.
    assert (slope[held & (x == low)] >= -1e-9).all() and (slope[held & (x == high)] <= 1e-9).all()


def test_far_bounds_change_nothing():
    matrix, pull, low, high = problem(0, tight=1e6)
    x, held = least(matrix, pull, low - 1e6, high + 1e6)
    assert not held.any()
    np.testing.assert_allclose(x, np.linalg.solve(matrix, pull))
