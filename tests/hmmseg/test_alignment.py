"""Alignments against enumeration of every path: an oracle that shares no code with the recursions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_enumeration import brute, random_problem
from scipy.stats import chisquare

from experiments.jax_hmm.alignment import forward, forward_backward, sample_alignments, viterbi
from hmmseg.hmm.alignment import align, align_many
from hmmseg.hmm.chain import InfeasibleAlignment

SIZES = [(1, 1), (4, 1), (2, 2), (5, 2), (4, 4), (6, 3), (8, 4)]


@pytest.mark.parametrize("num_skips", [0, 1, 2])
@pytest.mark.parametrize("size", SIZES)
def test_every_quantity_matches_enumeration(size, num_skips):
    ll, bands = random_problem(*size, seed=sum(size), num_skips=num_skips)
    paths, weights, log_evidence, smoothed, moves = brute(ll, bands)
    arguments = (ll, bands[0], bands[1], bands[2:])

    best = viterbi(*arguments)
    assert best.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(best.log_prob, weights.max(), rtol=1e-12)

    posterior = forward_backward(*arguments)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence, rtol=1e-12)
    np.testing.assert_allclose(np.exp(posterior.log_smoothed), smoothed, atol=1e-12)
    for ours, theirs in zip((posterior.log_advance, *posterior.log_skip), moves, strict=True):
        np.testing.assert_allclose(np.exp(ours), theirs, atol=1e-12)


def test_filtered_probabilities_are_posteriors_of_every_prefix():
    ll, bands = random_problem(7, 3, seed=3)
    filtered = forward(ll, *bands, log_final=np.zeros(3)).log_filtered
    for t in range(7):
        cut = (ll[: t + 1], tuple(band[:t] for band in bands))
        smoothed = brute(*cut, final=np.zeros(3))[3]
        np.testing.assert_allclose(np.exp(filtered[t]), smoothed[-1], atol=1e-12)
    np.testing.assert_allclose(forward(ll, *bands).log_evidence, brute(ll, bands)[2])


def test_open_ends():
    ll, bands = random_problem(6, 3, seed=4)
    ends = {"initial": np.array([0.0, -1.0, -2.0]), "final": np.array([-3.0, 0.5, 0.0])}
    posterior = forward_backward(ll, *bands, log_initial=ends["initial"], log_final=ends["final"])
    _, _, log_evidence, smoothed, _ = brute(ll, bands, **ends)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence)
    np.testing.assert_allclose(np.exp(posterior.log_smoothed), smoothed, atol=1e-12)


def test_constant_transitions_broadcast():
    ll, _ = random_problem(6, 3)
    stay, advance = np.log([0.9, 0.8, 1.0]), np.log([0.1, 0.2])
    full = np.tile(stay, (5, 1)), np.tile(advance, (5, 1))
    np.testing.assert_array_equal(
        forward_backward(ll, stay, advance).log_smoothed, forward_backward(ll, *full).log_smoothed
    )


@pytest.mark.parametrize("num_skips", [0, 1])
def test_draws_have_the_exact_path_probabilities(num_skips):
    # Transitions vary strongly in time: a sampler off by one in t fails by a wide margin.
    ll, bands = random_problem(5, 3, seed=11, num_skips=num_skips)
    bands = tuple(2.0 * band for band in bands)
    paths, weights, log_evidence, *_ = brute(ll, bands)
    num_samples = 20_000
    drawn = np.asarray(sample_alignments(jax.random.key(5), ll, bands[0], bands[1], num_samples, bands[2:]))
    expected = np.exp(weights - log_evidence) * num_samples
    counts = np.array([(drawn == path).all(1).sum() for path in paths])
    assert counts.sum() == num_samples
    common = expected >= 5
    observed = np.append(counts[common], counts[~common].sum())
    wanted = np.append(expected[common], expected[~common].sum())
    if wanted[-1] < 1e-9:
        observed, wanted = observed[:-1], wanted[:-1]
    assert chisquare(observed, wanted).pvalue > 1e-3


def test_gradients_of_the_log_evidence_are_the_posteriors():
    ll, bands = random_problem(7, 4, seed=6, num_skips=1)

    def log_evidence(ll, bands):
        return forward(ll, bands[0], bands[1], bands[2:]).log_evidence

    posterior = forward_backward(ll, bands[0], bands[1], bands[2:])
    d_ll, d_bands = jax.grad(log_evidence, argnums=(0, 1))(jnp.asarray(ll), tuple(map(jnp.asarray, bands)))
    np.testing.assert_allclose(d_ll, np.exp(posterior.log_smoothed), atol=1e-10)
    np.testing.assert_allclose(d_bands[1], np.exp(posterior.log_advance), atol=1e-10)
    np.testing.assert_allclose(d_bands[2], np.exp(posterior.log_skip[0]), atol=1e-10)


def test_gradients_stay_finite_where_states_are_impossible():
    ll, bands = random_problem(6, 3, seed=7)
    ll[2, 1] = ll[0, 2] = -np.inf
    gradient = jax.grad(lambda ll: forward(ll, *bands).log_evidence)(jnp.asarray(ll))
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("fill", [0.0, 7.0, np.nan, -np.inf])
def test_padding_changes_nothing(fill):
    ll, bands = random_problem(6, 3, seed=8, num_skips=1)
    padded = np.pad(ll, ((0, 10), (0, 0)), constant_values=fill)
    padded_bands = tuple(np.pad(band, ((0, 10), (0, 0)), constant_values=fill) for band in bands)
    plain = forward_backward(ll, bands[0], bands[1], bands[2:])
    wide = forward_backward(padded, padded_bands[0], padded_bands[1], padded_bands[2:], num_valid=6)
    np.testing.assert_allclose(wide.log_evidence, plain.log_evidence, rtol=1e-14)
    np.testing.assert_allclose(wide.log_smoothed[:6], plain.log_smoothed, rtol=1e-12)
    np.testing.assert_allclose(wide.log_advance[:5], plain.log_advance, rtol=1e-12)
    assert np.isneginf(wide.log_advance[5:]).all()
    best = viterbi(padded, padded_bands[0], padded_bands[1], padded_bands[2:], num_valid=6)
    assert best.path[:6].tolist() == viterbi(ll, bands[0], bands[1], bands[2:]).path.tolist()
    drawn = sample_alignments(
        jax.random.key(0), padded, padded_bands[0], padded_bands[1], 50, padded_bands[2:], num_valid=6
    )
    assert (np.asarray(drawn[:, 5:]) == 2).all()


def test_numpy_wrappers_agree_with_the_recursions():
    ll, bands = random_problem(8, 4, seed=9, num_skips=1)
    paths, weights, log_evidence, smoothed, moves = brute(ll, bands)
    aligned = align(ll, bands[0], bands[1], bands[2:])
    assert aligned.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(aligned.log_evidence, log_evidence)
    np.testing.assert_allclose(aligned.smoothed, smoothed, atol=1e-12)
    np.testing.assert_allclose(aligned.moves[1], moves[1], atol=1e-12)


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
    calls = [
        lambda: viterbi(ll, *bands),
        lambda: forward(ll, *bands),
        lambda: forward_backward(ll, *bands),
        lambda: sample_alignments(jax.random.key(0), ll, *bands, 3),
        lambda: align(ll, *bands),
    ]
    for call in calls:
        with pytest.raises(InfeasibleAlignment, match=reason) as caught:
            call()
        assert caught.value.subtask == subtask
        assert f"subtask {subtask} starves" in str(caught.value)


def test_infeasible_trial_in_a_batch_raises():
    good, _ = random_problem(6, 3)
    bad = good.copy()
    bad[:, 2] = -np.inf
    with pytest.raises(InfeasibleAlignment, match="subtask 2"):
        align_many([good, bad], [(np.zeros(3), np.zeros(2))] * 2)


@pytest.mark.parametrize("function", [viterbi, forward, forward_backward, align])
def test_nan_and_wrong_shapes_are_refused(function):
    ll, bands = random_problem(6, 3)
    with pytest.raises(ValueError, match=r"log_(stay|advance): shape .*expected"):
        function(ll, bands[1], bands[1])
    ll[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"log_likelihoods: NaN or \+inf at \[2, 1\]"):
        function(ll, *bands)


def test_traced_use_returns_minus_infinity_instead_of_raising():
    ll, bands, *_ = infeasible()[0]
    assert np.isneginf(jax.jit(lambda ll: viterbi(ll, *bands).log_prob)(ll))


def test_single_precision_stays_so_and_moves_no_label():
    """A long recording of states half a standard deviation apart: sums not rebased would drift by nats."""
    rng = np.random.default_rng(5)
    num = 60_000
    signal = 0.5 * (np.arange(num) * 4 // num) + rng.normal(size=num)
    ll = (-0.5 * (signal[:, None] - 0.5 * np.arange(4)) ** 2 - 20.0).astype(np.float32)
    stay, advance = np.log(np.full(4, 0.999)), np.log(np.full(3, 0.001))
    single = viterbi(ll, stay.astype(np.float32), advance.astype(np.float32))
    double = viterbi(ll.astype(float), stay.astype(np.float32), advance.astype(np.float32))
    assert single.path.tolist() == double.path.tolist()
    np.testing.assert_allclose(single.log_prob, double.log_prob, rtol=1e-7)


def test_best_path_differentiates_to_its_own_samples():
    """The gradient of the best weight counts the samples of the path, padding left out."""
    ll, bands = random_problem(7, 3, seed=2)
    best = viterbi(ll[:5], bands[0][:4], bands[1][:4])
    padded = ll.copy()
    padded[5:] = np.nan
    for dtype in (float, np.float32):
        arguments = [jnp.asarray(a, dtype) for a in (padded, *bands)]
        found = jax.grad(lambda x, a=arguments: viterbi(x, *a[1:], num_valid=5).log_prob)(arguments[0])
        np.testing.assert_array_equal(np.asarray(found)[:5], np.eye(3)[np.asarray(best.path)])
