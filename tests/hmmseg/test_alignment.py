"""Alignments against enumeration of every path: an oracle that shares no code with the recursions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_enumeration import brute, random_problem

from experiments.jax_viterbi import viterbi
from hmmseg.hmm.alignment import align, align_many
from hmmseg.hmm.chain import InfeasibleAlignment

SIZES = [(1, 1), (4, 1), (2, 2), (5, 2), (4, 4), (6, 3), (8, 4)]


@pytest.mark.parametrize("num_skips", [0, 1, 2])
@pytest.mark.parametrize("size", SIZES)
def test_every_quantity_matches_enumeration(size, num_skips):
    ll, bands = random_problem(*size, seed=sum(size), num_skips=num_skips)
    paths, weights, log_evidence, smoothed, moves = brute(ll, bands)
    aligned = align(ll, bands[0], bands[1], bands[2:])
    assert aligned.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(aligned.log_prob, weights.max(), rtol=1e-12)
    np.testing.assert_allclose(aligned.log_evidence, log_evidence, rtol=1e-12)
    np.testing.assert_allclose(aligned.smoothed, smoothed, atol=1e-12)
    for ours, theirs in zip(aligned.moves, moves, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_batch_equals_one_by_one():
    trials = [random_problem(n, 3, seed=n)[0] for n in (5, 9, 300)]
    stay, advance = np.log([0.9, 0.8, 1.0]), np.log([0.1, 0.2])
    for ll, batched in zip(trials, align_many(trials, [(stay, advance)] * 3), strict=True):
        single = align(ll, stay, advance)
        assert batched.path.tolist() == single.path.tolist()
        np.testing.assert_allclose(batched.smoothed, single.smoothed, rtol=1e-9)
    assert align_many([], []) == []


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
        align(ll, *bands)
    assert caught.value.subtask == subtask
    assert f"subtask {subtask} starves" in str(caught.value)


def test_infeasible_trial_in_a_batch_raises():
    good, _ = random_problem(6, 3)
    bad = good.copy()
    bad[:, 2] = -np.inf
    with pytest.raises(InfeasibleAlignment, match="subtask 2"):
        align_many([good, bad], [(np.zeros(3), np.zeros(2))] * 2)


@pytest.mark.parametrize("varying", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_the_peer_in_jax_finds_the_same_path(size, varying):
    ll, bands = random_problem(*size, seed=sum(size))
    if not varying:
        bands = tuple(np.tile(band[:1], (size[0] - 1, 1)) for band in bands)
    paths, weights, *_ = brute(ll, bands)
    best = jax.jit(viterbi)(
        jnp.asarray(ll), *(jnp.asarray(b if varying or len(b) == 0 else b[0]) for b in bands)
    )
    assert best.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(best.log_prob, weights.max(), rtol=1e-12)


def test_nan_and_wrong_shapes_are_refused():
    ll, bands = random_problem(6, 3)
    with pytest.raises(ValueError, match=r"log_(stay|advance): shape .*expected"):
        align(ll, bands[1], bands[1])
    ll[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"log_likelihoods: NaN or \+inf at \[2, 1\]"):
        align(ll, *bands)


def test_single_precision_stays_so_and_moves_no_label():
    """A long recording of states half a standard deviation apart: sums not rebased would drift by nats."""
    rng = np.random.default_rng(5)
    num = 60_000
    signal = 0.5 * (np.arange(num) * 4 // num) + rng.normal(size=num)
    ll = (-0.5 * (signal[:, None] - 0.5 * np.arange(4)) ** 2 - 20.0).astype(np.float32)
    stay, advance = np.log(np.full(4, 0.999)), np.log(np.full(3, 0.001))
    single, double = (
        viterbi(*(jnp.asarray(a, kind) for a in (ll, stay, advance))) for kind in (np.float32, float)
    )
    assert single.path.tolist() == double.path.tolist()
    np.testing.assert_allclose(single.log_prob, double.log_prob, rtol=1e-7)
