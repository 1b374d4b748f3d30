"""The scikit-learn estimator: steps found, labels used, and scikit-learn's own checks where they apply."""

import numpy as np
import pytest

pytest.importorskip("sklearn")

from sklearn.base import clone
from sklearn.utils.estimator_checks import check_estimator

from hmmseg.sequence.estimator import OrderedSegmenter


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


EXPECTED = {
    "check_clustering": "rows are samples in time, not points to be clustered in any order",
    "check_methods_sample_order_invariance": "the order of the samples is what is modelled",
    "check_methods_subset_invariance": "a stretch of a sequence is another sequence",
}


def test_scikit_learns_own_checks():
    check_estimator(OrderedSegmenter(), expected_failed_checks=EXPECTED, on_skip=None)
