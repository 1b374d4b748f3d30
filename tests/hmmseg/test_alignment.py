"""Alignments against enumeration of every path: an oracle that shares no code with the recursions."""

import numpy as np
import pytest
from path_enumeration import brute, random_problem

from hmmseg.hmm import Chain, InfeasibleAlignment
from hmmseg.hmm.inference import align


def test_path_and_posterior_come_together():
    ll, bands = random_problem(8, 3, seed=1)
    paths, weights, log_evidence, smoothed, moves = brute(ll, bands)
    (aligned,) = align([ll], [Chain(*bands)])
    assert aligned.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(aligned.log_prob, weights.max(), rtol=1e-12)
    np.testing.assert_allclose(aligned.log_evidence, log_evidence, rtol=1e-12)
    np.testing.assert_allclose(aligned.smoothed, smoothed, atol=1e-12)
    np.testing.assert_allclose(aligned.boundary, moves[0], atol=1e-12)


def test_many_recordings_equal_one_by_one():
    """More than go into one call, of two lengths of the ladder, each with a chain of its own."""
    trials = [random_problem(n % 7 + 3 if n % 9 else 300, 3, seed=n)[0] for n in range(75)]
    chains = [Chain(np.log([0.9, 0.8, 1.0]) + 0.01 * i, np.log([0.1, 0.2])) for i in range(75)]
    for ll, chain, found in zip(trials, chains, align(trials, chains), strict=True):
        (alone,) = align([ll], [chain])
        assert found.path.tolist() == alone.path.tolist()
        np.testing.assert_allclose(found.smoothed, alone.smoothed, rtol=1e-9)
    assert align([], []) == []


def infeasible():
    ll, bands = random_problem(6, 3, seed=1)
    starved, dead_start, dead_end, dead_middle = (ll.copy() for _ in range(4))
    starved[:, 1] = -np.inf
    dead_start[0, 0] = -np.inf
    dead_end[5, 2] = -np.inf
    dead_middle[3] = -np.inf
    no_advance = (bands[0], np.where([True, False], bands[1], -np.inf))
    few, few_bands = random_problem(2, 3)
    return [
        (starved, bands, 1, "no sample is possible under it"),
        (dead_start, bands, 0, "no path reaches it"),
        (dead_end, bands, 2, "cannot be held to the end"),
        (dead_middle, bands, 2, "cannot be held to the end"),
        (ll, no_advance, 2, "no path reaches it"),
        (few, few_bands, 2, "2 samples are too few"),
    ]


@pytest.mark.parametrize("case", range(6))
def test_infeasible_alignments_say_which_subtask_starves(case):
    ll, bands, subtask, reason = infeasible()[case]
    with pytest.raises(InfeasibleAlignment, match=reason) as caught:
        align([ll], [Chain(*bands)])
    assert caught.value.subtask == subtask
    assert f"subtask {subtask} starves" in str(caught.value)


def test_infeasible_trial_in_a_batch_raises():
    good, _ = random_problem(6, 3)
    bad = good.copy()
    bad[:, 2] = -np.inf
    with pytest.raises(InfeasibleAlignment, match="subtask 2"):
        align([good, bad], [Chain(np.zeros(3), np.zeros(2))] * 2)


def test_nan_and_wrong_shapes_are_refused():
    ll, bands = random_problem(6, 3)
    with pytest.raises(ValueError, match=r"log_(stay|advance): shape .*expected"):
        align([ll], [Chain(bands[1], bands[1])])
    ll[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"log_likelihoods: NaN or \+inf at \[2, 1\]"):
        align([ll], [Chain(*bands)])
