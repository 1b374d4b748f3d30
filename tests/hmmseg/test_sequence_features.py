"""Pieces of the plain ordered task: grid, starts, tempering, detectors."""

import itertools

import numpy as np
import pytest

from hmmseg.io.trial import Trial
from hmmseg.sequence.courses import partition
from hmmseg.sequence.emissions import from_weights, independent_share, learn, transitions
from hmmseg.sequence.features import cell_means, edge_preserving_slopes, feature_map, features, without_old


def test_cells_average_samples_and_stay_empty_where_there_are_none():
    t = np.array([0.0, 0.1, 0.2, 1.0, 1.1, 3.0])
    trial = Trial("x", t, {"a": np.array([1.0, 2.0, np.nan, 5.0, 7.0, 9.0])})
    edges, means = cell_means(trial, ("a",), 1.0)
    np.testing.assert_allclose(edges, [0, 1, 2, 3])
    np.testing.assert_allclose(means[:, 0], [1.5, 6.0, 9.0])
    edges, means = cell_means(trial, ("a",), 0.5)
    assert np.isnan(means[3, 0])
    assert edges[-1] == pytest.approx(3.0)


def test_readings_repeated_to_the_last_digit_are_old_ones():
    rng = np.random.default_rng(0)
    slow = rng.normal(size=40)
    np.testing.assert_array_equal(without_old(np.repeat(slow, 4))[::4], slow)
    assert np.isnan(without_old(np.repeat(slow, 4))).sum() == 120
    again = np.repeat(np.r_[slow[:20], slow[19], slow[20:]], 4)  # a reading that is the same once more
    assert np.isfinite(without_old(again)).sum() == 41
    for fresh in (slow, np.round(np.cumsum(rng.normal(size=200))), np.zeros(50)):  # quantised, constant
        np.testing.assert_array_equal(without_old(fresh), fresh)


def test_features_do_not_depend_on_units():
    rng = np.random.default_rng(0)
    t = np.arange(200) / 20
    x = rng.normal(size=200).cumsum()
    one = Trial("x", t, {"a": x})
    other = Trial("x", t, {"a": 1000 * x - 7})
    values = [features(trial, feature_map([trial], ("a",))).values for trial in (one, other)]
    np.testing.assert_allclose(values[0], values[1], atol=1e-9)


def test_slope_of_a_ramp():
    t = np.arange(400) / 20
    trial = Trial("x", t, {"a": 3 * t})
    mapping = feature_map([trial], ("a",))
    slope = features(trial, mapping).values[:, 1] * mapping.scale[1] + mapping.center[1]
    np.testing.assert_allclose(slope[5:-5], 3.0, rtol=1e-6)


def test_no_slope_looks_across_a_jump():
    x = np.concatenate([0.5 * np.arange(60), 40 - 0.2 * np.arange(60)])[:, None]
    slope = edge_preserving_slopes(x, 9)[:, 0]
    np.testing.assert_allclose(slope, np.repeat([0.5, -0.2], 60), atol=1e-9)


@pytest.mark.parametrize("num_stretches", [1, 2, 3])
def test_partition_is_the_best_of_all(num_stretches):
    rng = np.random.default_rng(num_stretches)
    values = rng.normal(size=(9, 2)) + np.repeat([[0.0, 1.0], [3.0, 1.0], [3.0, -2.0]], 3, axis=0)
    floor = 0.3

    def cost(cuts):
        stretches = np.split(values, cuts)
        return sum(len(s) / 2 * np.log(s.var(0) + floor**2).sum() for s in stretches)

    best = min(itertools.combinations(range(1, 9), num_stretches - 1), key=cost)
    path = partition(values, num_stretches, floor)
    assert np.flatnonzero(np.diff(path)).tolist() == [cut - 1 for cut in best]
    assert path.max() == num_stretches - 1


def test_partition_needs_a_cell_a_stretch():
    with pytest.raises(ValueError, match="2 cells, expected at least 3"):
        partition(np.zeros((2, 1)), 3, 0.1)


def test_share_of_independent_observations():
    rng = np.random.default_rng(1)
    white = rng.normal(size=(4000, 3))
    assert independent_share([white]) == pytest.approx(1.0, rel=0.1)
    phi = 0.8  # integrated autocorrelation time of AR(1): (1 + phi) / (1 - phi) = 9
    slow = np.zeros((40000, 1))
    for i, e in enumerate(rng.normal(size=39999), 1):
        slow[i] = phi * slow[i - 1] + e
    assert independent_share([slow]) == pytest.approx(1 / 9, rel=0.25)
    assert independent_share([np.repeat(white[:, :1], 5, axis=1)]) == pytest.approx(1 / 5, rel=0.15)


def test_emissions_shrug_off_outliers():
    rng = np.random.default_rng(2)
    x = rng.normal(2.0, 0.5, size=(500, 1))
    x[:15] = 80.0
    emissions = from_weights(x, np.ones((500, 1)), 0.01, 1.0, iterations=50)
    assert emissions.loc[0, 0] == pytest.approx(2.0, abs=0.1)
    assert 0.3 < emissions.scale[0, 0] < 0.7


def test_missing_features_say_nothing():
    emissions = from_weights(np.array([[0.0], [1.0], [2.0]]), np.ones((3, 1)), 0.1, 1.0)
    assert emissions.log_likelihoods(np.array([[np.nan]]))[0, 0] == 0.0


def test_transitions_are_probabilities():
    law = transitions(
        np.array([5.0, 8.0, 3.0, 4.0]), np.array([0.9, 0.3, 0.6, 0.5]), [False, True, True, False]
    )
    assert len(law.bands) == 4
    for k in range(4):
        leaving = sum(np.exp(band[k]) for band in law.bands if k < band.size)
        assert leaving == pytest.approx(1.0)
    assert np.exp(law.log_initial).sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(np.isfinite(law.log_final), [False, False, False, True])


def test_detectors_find_a_learned_course():
    rng = np.random.default_rng(3)
    bump = np.exp(-0.5 * ((np.arange(40) - 20) / 4) ** 2)[:, None] * 5

    def record(at):
        x = rng.normal(size=(300, 1)) * 0.5
        x[at : at + 40] += bump
        return x

    detectors = learn(
        [record(at) for at in (50, 120, 200)], [np.array([at + 25]) for at in (50, 120, 200)], 15
    )
    assert detectors.log_ratios(record(90))[:, 0].argmax() == pytest.approx(90 + 25, abs=2)
    unseen = learn([record(50), record(80)], [np.array([-1]), np.array([-1])], 15)
    np.testing.assert_array_equal(unseen.log_ratios(record(90)), 0.0)
