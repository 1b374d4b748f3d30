"""Robust statistics against samples whose spread is known, and against plain medians."""

import numpy as np
import pytest

from hmmseg.robust import bridged, robust_sd, weighted_median, white_sd


def test_a_twentieth_of_wild_samples_hardly_moves_a_deviation():
    residual = np.random.default_rng(0).normal(0.0, 2.0, 100_000)
    assert robust_sd(residual) == pytest.approx(2.0, rel=0.01)
    residual[::20] = 1e6
    assert robust_sd(residual) == pytest.approx(2.0, rel=0.08)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_white_noise_is_seen_on_a_bending_signal(order):
    t = np.arange(100_000)
    signal = np.sin(t / 500) + np.random.default_rng(1).normal(0.0, 0.1, t.size)
    assert white_sd(signal, order) == pytest.approx(0.1, rel=0.02)


def test_a_weighted_median_is_that_of_repeated_values():
    rng = np.random.default_rng(2)
    values, times = rng.normal(size=31), rng.integers(1, 9, 31)
    times[0] += 1 - times.sum() % 2  # an odd number of values has one in the middle
    assert weighted_median(values, times.astype(float)) == np.median(np.repeat(values, times))


def test_gaps_are_bridged_in_time():
    values = np.array([0.0, np.nan, np.nan, 9.0])
    np.testing.assert_allclose(bridged(values), [0, 3, 6, 9])
    np.testing.assert_allclose(bridged(values, np.array([0.0, 1.0, 8.0, 9.0])), [0, 1, 8, 9])
    assert bridged(np.ones(3)).tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(ValueError, match="empty"):
        bridged(np.full(3, np.nan))


def test_a_weighted_median_is_of_what_is_there():
    assert weighted_median(np.array([np.nan, 1.0, 9.0]), np.array([9.0, 1.0, 3.0])) == 9.0
