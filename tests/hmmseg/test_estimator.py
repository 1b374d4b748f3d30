"""The scikit-learn estimator: steps found, labels used, and scikit-learn's own checks where they apply."""

import numpy as np
import pytest

pytest.importorskip("sklearn")

from sklearn.base import clone
from sklearn.utils.estimator_checks import check_estimator

from hmmseg import segment
from hmmseg.sequence.estimator import OrderedSegmenter

EXPECTED = {"check_clustering": "rows are samples in time, not points to be clustered in any order",
            "check_methods_sample_order_invariance": "the order of the samples is what is modelled",
            "check_methods_subset_invariance": "a stretch of a sequence is another sequence"}  # fmt: skip


def steps(seed, edges=(60, 140), length=200):
    rng = np.random.default_rng(seed)
    states = np.searchsorted(edges, np.arange(length), side="right")
    return np.stack([states * 1.0, 2.0 - states], axis=1) + 0.1 * rng.normal(size=(length, 2)), states


def test_one_sequence():
    x, states = steps(0)
    found = OrderedSegmenter(n_states=3, rate=50.0).fit(x)
    assert (found.labels_ != states).mean() < 0.03
    np.testing.assert_array_equal(found.fit_predict(x), found.predict(x))


def test_several_some_of_them_labelled():
    sequences = [steps(k, (50 + 5 * k, 130 + 4 * k)) for k in range(4)]
    x, y = [s[0] for s in sequences], [s[1] for s in sequences]
    found = clone(OrderedSegmenter(n_states=3, rate=50.0)).fit(x, [y[0], y[1], None, None])
    for got, wanted in zip(found.predict(x), y, strict=True):
        assert (got != wanted).mean() < 0.03


def test_abrupt_changes_are_dated_where_they_jump_and_short_states_are_there():
    """States of 10 samples after a wait of 19 s are all predicted; a change is dated between two samples."""
    truth = np.array([19.2, 19.4, 19.6])
    states = np.searchsorted(truth, np.arange(1000) / 50, side="right")
    x = [3.0 * states[:, None] + np.random.default_rng(k).normal(0, 0.2, (1000, 1)) for k in range(3)]
    found = OrderedSegmenter(n_states=4, rate=50.0).fit(x)
    for predicted in found.predict(x):
        assert (np.diff(predicted) >= 0).all() and set(predicted) == {0, 1, 2, 3}
    y = np.array([0, 0.3, 0.2, 0.1, 10, 11, 12, 13])
    spans = segment({"t": np.arange(8.0), "y": y}, {"sequence": ["low", "high"]})[0].spans
    assert spans[1].start == 3.5 and spans[1].start_90[0] <= 3.5 <= spans[1].start_90[1]


def test_scikit_learns_own_checks():
    check_estimator(OrderedSegmenter(), expected_failed_checks=EXPECTED, on_skip=None)
