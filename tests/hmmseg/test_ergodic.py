"""The unconstrained model against enumeration of every state path."""

import itertools

import numpy as np
import pytest

from hmmseg.hmm.dense import log_evidence, viterbi


def problem(num_timesteps, num_states, seed=0):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(num_timesteps, num_states)),
        rng.normal(size=num_states),
        rng.normal(size=(num_states, num_states)),
    )


def enumerate_paths(ll, initial, transition):
    paths = list(itertools.product(range(ll.shape[1]), repeat=len(ll)))
    weights = [
        initial[p[0]] + sum(ll[t, k] for t, k in enumerate(p))
        + sum(transition[i, j] for i, j in itertools.pairwise(p))
        for p in paths
    ]  # fmt: skip
    return paths, np.array(weights)


@pytest.mark.parametrize("size", [(1, 1), (1, 3), (5, 2), (6, 4)])
def test_matches_enumeration(size):
    ll, initial, transition = problem(*size, seed=sum(size))
    if size[1] > 2:
        transition[0, 1] = initial[2] = -np.inf
    paths, weights = enumerate_paths(ll, initial, transition)
    best = viterbi(ll, initial, transition)
    assert tuple(best.path.tolist()) == paths[weights.argmax()]
    np.testing.assert_allclose(best.log_prob, weights.max())
    np.testing.assert_allclose(log_evidence(ll, initial, transition), np.logaddexp.reduce(weights))


def test_states_of_almost_no_likelihood_keep_their_evidence():
    """Where the only path leads through them, their weights do not underflow to nothing."""
    ll, initial, transition = problem(40, 3)
    ll[:, 1] = -1e3
    initial[[0, 2]] = -np.inf
    transition[1, [0, 2]] = -np.inf
    alone = initial[1] + ll[:, 1].sum() + 39 * transition[1, 1]
    np.testing.assert_allclose(log_evidence(ll, initial, transition), alone)
    assert (viterbi(ll, initial, transition).path == 1).all()


def test_refusals():
    ll, initial, transition = problem(4, 2)
    with pytest.raises(ValueError, match=r"log_transition: shape \(2,\), expected \(2, 2\)"):
        viterbi(ll, initial, initial)
    with pytest.raises(ValueError, match="no state path"):
        viterbi(np.full((4, 2), -np.inf), initial, transition)
    ll[1, 1] = np.nan
    with pytest.raises(ValueError, match=r"log_likelihoods: NaN at \[1, 1\]"):
        log_evidence(ll, initial, transition)
