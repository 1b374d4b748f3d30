"""The library hmmseg.hmm on plain arrays, against enumeration of every path."""

import pickle

import numpy as np
import pytest
from path_enumeration import brute, random_problem
from scipy.stats import chisquare

import hmmseg.hmm as hmm

SIZES = [(1, 1), (4, 1), (2, 2), (5, 2), (4, 4), (6, 3), (8, 4)]


def chain_of(bands, **ends):
    return hmm.Chain(bands[0], bands[1], bands[2:] or None, **ends)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("num_skips", [0, 1, 2])
@pytest.mark.parametrize("size", SIZES)
def test_every_quantity_matches_enumeration(size, num_skips, single):
    ll, bands = random_problem(*size, seed=sum(size), num_skips=num_skips)
    if single:
        ll = ll.astype(np.float32)
    paths, weights, log_evidence, smoothed, moves = brute(ll.astype(float), bands)
    chain = chain_of(bands)

    best = hmm.viterbi(ll, chain)
    assert best.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(best.log_prob, weights.max(), rtol=1e-12)

    posterior = hmm.smooth(ll, chain)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence, rtol=1e-12)
    np.testing.assert_allclose(posterior.smoothed, smoothed, atol=1e-12)
    assert len(posterior.moves) == len(moves)
    for ours, theirs in zip(posterior.moves, moves, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    np.testing.assert_allclose(hmm.log_evidence(ll, chain), log_evidence, rtol=1e-12)

    ranked = hmm.k_best(ll, chain, 7)
    order = np.argsort(-weights)[:7]
    np.testing.assert_allclose(ranked.log_prob, weights[order], rtol=1e-12)
    assert [a.path.tolist() for a in ranked] == paths[order].tolist()


@pytest.mark.parametrize("num_skips", [0, 1])
def test_filtered_probabilities_are_posteriors_of_every_prefix(num_skips):
    ll, bands = random_problem(7, 3, seed=3, num_skips=num_skips)
    found = hmm.forward(ll, chain_of(bands))
    np.testing.assert_allclose(found.log_evidence, brute(ll, bands)[2])
    for t in range(7):
        smoothed = brute(ll[: t + 1], tuple(band[:t] for band in bands), final=np.zeros(3))[3]
        np.testing.assert_allclose(found.filtered[t], smoothed[-1], atol=1e-12)


def test_open_ends_and_transitions_that_do_not_vary():
    ll, bands = random_problem(6, 3, seed=4)
    ends = {"initial": np.array([0.0, -1.0, -2.0]), "final": np.array([-3.0, 0.5, 0.0])}
    rows = [band[0] for band in bands]
    chain = hmm.Chain(*rows, log_initial=ends["initial"], log_final=ends["final"])
    paths, weights, log_evidence, smoothed, _ = brute(ll, [np.tile(row, (5, 1)) for row in rows], **ends)
    for each in (chain, pickle.loads(pickle.dumps(chain))):
        posterior = hmm.smooth(ll, each)
        np.testing.assert_allclose(posterior.log_evidence, log_evidence)
        np.testing.assert_allclose(posterior.smoothed, smoothed, atol=1e-12)
        assert hmm.viterbi(ll, each).path.tolist() == paths[weights.argmax()].tolist()


@pytest.mark.parametrize("num_skips", [0, 1])
def test_draws_have_the_exact_path_probabilities(num_skips):
    # Transitions vary strongly in time: a sampler off by one in t fails by a wide margin.
    ll, bands = random_problem(5, 3, seed=11, num_skips=num_skips)
    bands = tuple(2.0 * band for band in bands)
    ends = {"initial": np.array([0.0, 0.5, -1.0]), "final": np.array([-1.0, 0.5, 0.0])}
    paths, weights, log_evidence, *_ = brute(ll, bands, **ends)
    chain = chain_of(bands, log_initial=ends["initial"], log_final=ends["final"])
    num_draws = 20_000
    drawn = np.array([a.path for a in hmm.sample(ll, chain, num_draws, seed=5)])
    expected = np.exp(weights - log_evidence) * num_draws
    counts = np.array([(drawn == path).all(1).sum() for path in paths])
    assert counts.sum() == num_draws
    common = expected >= 5
    observed = np.append(counts[common], counts[~common].sum())
    wanted = np.append(expected[common], expected[~common].sum())
    assert chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue > 1e-3


@pytest.mark.parametrize("num_states", [1, 2, 8, 9, 10, 17])
@pytest.mark.parametrize("varying", [False, True])
def test_long_recordings_equal_the_plain_recursion_in_logs(num_states, varying):
    # More samples than a block has, states across vectors' ends; weights span thousands of nats.
    rng = np.random.default_rng(num_states)
    n = 1300
    ll = 30 * rng.normal(size=(n, num_states))
    shape = (n - 1,) if varying else ()
    stay, advance = rng.normal(size=(*shape, num_states)), rng.normal(size=(*shape, num_states - 1))
    chain = hmm.Chain(stay, advance)
    never = np.full((*shape, max(num_states - 2, 0)), -np.inf)
    general = hmm.Chain(stay, advance, [never])  # with skips that never happen: other kernels
    assert hmm.viterbi(ll, chain).starts.tolist() == hmm.viterbi(ll, general).starts.tolist()
    ours, plain = hmm.smooth(ll, chain), hmm.smooth(ll, general)
    np.testing.assert_allclose(ours.log_evidence, plain.log_evidence, rtol=1e-13)
    np.testing.assert_allclose(ours.smoothed, plain.smoothed, atol=1e-10)
    np.testing.assert_allclose(ours.boundary, plain.boundary, atol=1e-10)
    np.testing.assert_allclose(hmm.forward(ll, chain).filtered, hmm.forward(ll, general).filtered, atol=1e-12)


def test_missing_samples_are_no_evidence():
    ll, bands = random_problem(7, 3, seed=5)
    gone = ll.copy()
    gone[2:4] = np.nan
    empty = ll.copy()
    empty[2:4] = 0.0
    for chain in (chain_of(bands), chain_of((*bands, np.full((6, 1), -np.inf)))):
        assert hmm.viterbi(gone, chain).starts.tolist() == hmm.viterbi(empty, chain).starts.tolist()
        np.testing.assert_array_equal(hmm.smooth(gone, chain).smoothed, hmm.smooth(empty, chain).smoothed)
        ll[5, 1] = np.nan
        for function in (hmm.viterbi, hmm.smooth, hmm.forward, hmm.log_evidence):
            with pytest.raises(ValueError, match=r"log_likelihoods: NaN or \+inf at \[5, 1\]"):
                function(ll, chain)


def test_nothing_underflows_or_overflows():
    rng = np.random.default_rng(1)
    ll = rng.normal(size=(5000, 4))
    ll[rng.integers(0, 5000, 200), rng.integers(0, 4, 200)] = -1250.0  # samples fifty sigma away
    ll[1000:1400, 2] = -1e5  # the chain must pass through what fits far worse than others
    ll[2000:3000] = np.nan  # a long gap
    ll[:, 3] -= 1e6
    ll[4000:, :3] = -np.inf
    chain = hmm.left_to_right([1000.0] * 4)
    posterior = hmm.smooth(ll, chain)
    assert np.isfinite(posterior.log_evidence)
    for each in (posterior.smoothed, posterior.boundary):
        assert ((each >= 0) & (each <= 1 + 1e-9)).all()
    np.testing.assert_allclose(posterior.smoothed.sum(1), 1.0)
    np.testing.assert_allclose(posterior.boundary.sum(0), 1.0)
    assert hmm.viterbi(ll, chain).starts[3] == np.flatnonzero(np.isfinite(ll[:, 0]))[-1] + 1


@pytest.mark.parametrize("single", [False, True])
def test_recordings_of_many_lengths_equal_one_by_one(single):
    rng = np.random.default_rng(2)
    kind = np.float32 if single else np.float64
    trials = [rng.normal(size=(n, 4)).astype(kind) for n in (4, 9, 300, 1200, 7, 30_000, 40_000)]
    chain = hmm.left_to_right([20.0, 5.0, 30.0, 10.0])
    padded = np.full((len(trials), 40_000, 4), 7.0, dtype=kind)
    for row, trial in zip(padded, trials, strict=True):
        row[: len(trial)] = trial
    together = hmm.viterbi(trials, chain)
    assert len(together) == len(trials)
    for batch in (together, hmm.viterbi(padded, chain, lengths=[len(t) for t in trials])):
        for each, trial in zip(batch, trials, strict=True):
            alone = hmm.viterbi(trial, chain)
            assert each.starts.tolist() == alone.starts.tolist()
            assert each.log_prob == alone.log_prob
            assert each.num_samples == len(trial)
    bad = [*trials, np.full((5, 4), -np.inf, kind)]
    with pytest.raises(hmm.InfeasibleAlignment):
        hmm.viterbi(bad, chain)
    bad[0] = trials[0].copy()
    bad[0][1, 2] = np.nan
    with pytest.raises(ValueError, match=r"\[1, 2\]"):
        hmm.viterbi(bad, chain)


def test_single_precision_input_loses_no_label_on_long_streams():
    # Weakly separated states and sums of 1e7 nats: single-precision sums would drift by nats.
    rng = np.random.default_rng(3)
    n, num_states = 1_000_000, 5
    mean = 0.05 * np.arange(num_states)
    y = mean[np.repeat(np.arange(num_states), n // num_states)] + rng.normal(size=n)
    ll = (-0.5 * (y[:, None] - mean) ** 2 - 10.0).astype(np.float32)
    chain = hmm.left_to_right([n / num_states] * num_states)
    assert hmm.viterbi(ll, chain).starts.tolist() == hmm.viterbi(ll.astype(float), chain).starts.tolist()


def test_boundaries_come_with_their_confidence():
    ll, bands = random_problem(8, 3, seed=9)
    paths, weights, log_evidence, *_ = brute(ll, bands)
    p = np.exp(weights - log_evidence)
    starts = np.array([[np.argmax(path >= k) for k in (1, 2)] for path in paths])
    chain = chain_of(bands)
    posterior, best = hmm.smooth(ll, chain), hmm.viterbi(ll, chain)
    for within in (0, 1, 3, 20):
        expected = [p[abs(starts[:, k] - best.starts[k + 1]) <= within].sum() for k in (0, 1)]
        np.testing.assert_allclose(posterior.confidence(best, within), expected, atol=1e-12)
    for q in (0.05, 0.5, 0.95):
        expected = [min(s for s in range(1, 8) if p[starts[:, k] <= s].sum() >= q) for k in (0, 1)]
        assert posterior.start_quantiles(q).tolist() == expected
    assert posterior.start_intervals(0.9).tolist() == np.stack(
        [posterior.start_quantiles(0.05), posterior.start_quantiles(0.95)], 1).tolist()  # fmt: skip


def test_optional_states_may_be_passed_over():
    presence = [1.0, 0.4, 0.7, 1.0]
    chain = hmm.left_to_right([3.0, 2.0, 2.0, 4.0], presence)
    ll = np.random.default_rng(6).normal(size=(7, 4))
    bands = [chain.band(d, 7) for d in range(len(chain.bands))]
    assert len(bands) == 4
    ends = {"initial": chain.log_initial, "final": chain.log_final}
    *_, log_evidence, smoothed, moves = brute(ll, bands, **ends)
    posterior = hmm.smooth(ll, chain)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence)
    np.testing.assert_allclose(posterior.smoothed, smoothed, atol=1e-12)
    # Who goes from 0 to 3 crosses all three boundaries at once.
    np.testing.assert_allclose(
        posterior.boundary[:, 1], moves[0][:, 1] + moves[1][:, :2].sum(1) + moves[2][:, 0], atol=1e-12
    )
    # Without evidence, a recording of any length visits the states as often as was said.
    flat = hmm.smooth(np.zeros((400, 4)), chain)
    visits = flat.smoothed[0] + np.array(
        [sum(m[:, k - d].sum() for d, m in enumerate(flat.moves, 1) if k >= d) for k in range(4)]
    )
    np.testing.assert_allclose(visits, presence, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hmm.Chain(np.zeros(3), np.zeros(3)), r"log_advance: shape \(3,\), expected \(2,\)"),
        (lambda: hmm.Chain(np.zeros((4, 3)), np.zeros((5, 2))), r"expected \(4, 2\) or \(2,\)"),
        (lambda: hmm.Chain(np.zeros(3), np.zeros(2), np.zeros(2)), r"log_skip\[0\]: shape \(2,\)"),
        (lambda: hmm.Chain(np.zeros((2, 2, 2)), np.zeros(2)), r"log_stay: shape \(2, 2, 2\)"),
        (lambda: hmm.Chain([0, np.nan], [0.0]), r"log_stay: NaN or \+inf at \[1\]"),
        (lambda: hmm.Chain([0, 1], [0.0], log_final=[0, np.inf]), r"log_final: NaN or \+inf at \[1\]"),
        (lambda: hmm.Chain([0, 1], [0.0], log_initial=[0]), r"log_initial: shape \(1,\), expected \(2,\)"),
        (lambda: hmm.viterbi(np.zeros((3, 2)), hmm.left_to_right([1, 1, 1])), "2 states, expected"),
        (lambda: hmm.smooth(np.zeros(3), hmm.left_to_right([1])), r"log_likelihoods: shape \(3,\)"),
        (lambda: hmm.smooth(np.zeros((9, 2)), hmm.Chain(np.zeros((4, 2)), [0.0])), "9 samples, expected 5"),
        (lambda: hmm.viterbi([np.zeros((3, 1))], [hmm.left_to_right([1])] * 2), "2 given, expected 1"),
        (lambda: hmm.viterbi(np.zeros((1, 3, 1)), hmm.left_to_right([1]), [4]), "4 for recording 0"),
        (lambda: hmm.viterbi(np.zeros((1, 3, 1)), hmm.left_to_right([1]), [3, 3]), "2 given, expected 1"),
        (lambda: hmm.k_best(np.zeros((3, 1)), hmm.left_to_right([1]), 0), "k: 0, expected"),
        (lambda: hmm.left_to_right([2.0, 3.0], [1.0]), r"presence: shape \(1,\), expected \(2,\)"),
        (lambda: hmm.left_to_right([2.0], [0.0]), r"probabilities in \(0, 1\]"),
        (lambda: hmm.smooth(np.full((3, 1), np.inf), hmm.left_to_right([1])), r"NaN or \+inf at \[0, 0\]"),
    ],
)  # fmt: skip
def test_refusals(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("function", ["viterbi", "smooth", "forward", "log_evidence", "k_best", "sample"])
@pytest.mark.parametrize("num_skips", [0, 1])
def test_infeasible_alignments_say_which_subtask_starves(function, num_skips):
    ll, bands = random_problem(6, 3, seed=1, num_skips=num_skips)
    for band in bands[2:]:
        band[:] = -np.inf
    starved, dead_end = ll.copy(), ll.copy()
    starved[:, 1] = -np.inf
    dead_end[5, 2] = -np.inf
    for table, subtask, reason in [(starved, 1, "no sample is possible under it"),
                                   (dead_end, 2, "cannot be held to the end")]:  # fmt: skip
        more = {"k_best": (3,), "sample": (3,)}.get(function, ())
        with pytest.raises(hmm.InfeasibleAlignment, match=reason) as caught:
            getattr(hmm, function)(table, chain_of(bands), *more)
        assert caught.value.subtask == subtask


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("apart", [0.01, 0.5, 3.0])
@pytest.mark.parametrize("num_states", [3, 12, 40])
def test_what_smoothing_leaves_out_is_nothing(num_states, apart, varying):
    # Many blocks, in which few or all states are probable; the plain recursion leaves out none.
    rng = np.random.default_rng(num_states)
    n = 3000
    state = np.sort(rng.integers(0, num_states, n))
    ll = -0.5 * (apart * (state[:, None] - np.arange(num_states)) + rng.normal(size=(n, 1))) ** 2
    ll[rng.integers(0, n, 20), rng.integers(0, num_states, 20)] -= 1250.0  # fifty standard deviations away
    ll[1000:1400] = np.nan
    ll[1700:1800, : num_states // 3] = -np.inf
    # Some thirds fit a stretch far better than the states on either side of them that the rest asks for.
    ll[1400:1500, 2 * num_states // 3 :] += 40.0
    shape = (n - 1,) if varying else ()
    stay, advance = rng.normal(size=(*shape, num_states)), rng.normal(size=(*shape, num_states - 1))
    never = np.full((*shape, num_states - 2), -np.inf)
    found = hmm.smooth(ll, hmm.Chain(stay, advance))
    plain = hmm.smooth(ll, hmm.Chain(stay, advance, [never]))
    np.testing.assert_allclose(found.log_evidence, plain.log_evidence, rtol=1e-13)
    np.testing.assert_allclose(found.smoothed, plain.smoothed, atol=1e-9)
    np.testing.assert_allclose(found.boundary, plain.boundary, atol=1e-9)
    np.testing.assert_allclose(found.smoothed.sum(1), 1.0, atol=1e-9)
