"""The library hmmseg.hmm: chains, streams and tables of durations, against enumeration of every path."""

import itertools
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from path_enumeration import brute, random_problem
from refusals import refused
from scipy.stats import chisquare

import hmmseg.hmm as hmm
from hmmseg.hmm.dense import log_evidence as dense_evidence
from hmmseg.hmm.dense import viterbi as dense_viterbi
from hmmseg.hmm.inference import align

SIZES = [(1, 1, 0), (8, 3, 0), (4, 4, 1), (8, 4, 1), (6, 3, 2)]  # samples, states, skips


def chain_of(bands, **ends):
    return hmm.Chain(bands[0], bands[1], bands[2:] or None, **ends)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_every_quantity_matches_enumeration(size, ends):
    """Single precision where ends are the first and the last state, double where they are open."""
    ll, bands = random_problem(*size[:2], seed=sum(size), num_skips=size[2])
    each = np.random.default_rng(4).normal(size=(2, size[1]))
    given = {"initial": each[0], "final": each[1]} if ends else {}
    ll = ll if ends else ll.astype(np.float32)
    paths, weights, log_evidence, smoothed, moves = brute(ll.astype(float), bands, **given)
    chain = pickle.loads(pickle.dumps(chain_of(bands, **{f"log_{name}": v for name, v in given.items()})))
    best = hmm.viterbi(ll, chain)
    assert best.path.tolist() == paths[weights.argmax()].tolist()
    np.testing.assert_allclose(best.log_prob, weights.max(), rtol=1e-12)
    posterior = hmm.smooth(ll, chain)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence, rtol=1e-12)
    np.testing.assert_allclose(posterior.smoothed, smoothed, atol=1e-12)
    assert len(posterior.moves) == len(moves)
    for ours, theirs in zip(posterior.moves, moves, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    for found in (hmm.log_evidence(ll, chain), hmm.filter(ll, chain).log_evidence):
        np.testing.assert_allclose(found, log_evidence, rtol=1e-12)
    ranked, order = hmm.k_best(ll, chain, 7), np.argsort(-weights)[:7]
    np.testing.assert_allclose(ranked.log_prob, weights[order], rtol=1e-12)
    assert [a.path.tolist() for a in ranked] == paths[order].tolist()


def assert_drawn(counts, expected):
    """Numbers of draws are as expected; rare ones together."""
    assert counts.sum() == pytest.approx(expected.sum())
    common = expected >= 5
    both = [np.append(each[common], each[~common].sum()) for each in (counts, expected)]
    observed, wanted = (each[both[1] > 0] for each in both)
    assert chisquare(observed, wanted).pvalue > 1e-3


@pytest.mark.parametrize("num_skips", [0, 1])
def test_draws_have_the_exact_path_probabilities(num_skips):
    # Transitions vary strongly in time: a sampler off by one in t fails by a wide margin.
    num_states = 3 + num_skips
    ll, bands = random_problem(5, num_states, seed=11, num_skips=num_skips)
    bands = tuple(2.0 * band for band in bands)
    ends = {"initial": np.linspace(0.5, -1.0, num_states), "final": np.linspace(-1.0, 0.5, num_states)}
    paths, weights, log_evidence, *_ = brute(ll, bands, **ends)
    chain = chain_of(bands, log_initial=ends["initial"], log_final=ends["final"])
    drawn = np.array([a.path for a in hmm.sample(ll, chain, 20_000, seed=5)])
    counts = np.array([(drawn == path).all(1).sum() for path in paths])
    assert_drawn(counts, np.exp(weights - log_evidence) * len(drawn))


def test_intervals_of_boundaries_match_enumeration():
    ll, bands = random_problem(8, 3, seed=9)
    paths, weights, log_evidence, *_ = brute(ll, bands)
    p = np.exp(weights - log_evidence)
    starts = np.array([[np.argmax(path >= k) for k in (1, 2)] for path in paths])
    chain = chain_of(bands)
    for level in (0.5, 0.9):
        ends = [(1 - level) / 2, (1 + level) / 2]
        expected = [[min(s for s in range(1, 8) if p[starts[:, k] <= s].sum() >= q) for q in ends]
                    for k in (0, 1)]  # fmt: skip
        assert hmm.smooth(ll, chain).start_intervals(level).tolist() == expected


@pytest.mark.parametrize(("num_states", "num_skips", "varying"), [(1, 0, False), (4, 0, True), (5, 1, False)])
def test_in_parallel_in_time_is_the_same(num_states, num_skips, varying):
    rng = np.random.default_rng(num_states)
    n = 128  # more take longer to compile
    ll = 5 * rng.normal(size=(n, num_states))
    ll[40:60] = np.nan
    ll[100:120, : num_states // 3] = -np.inf
    shape = (n - 1,) if varying else ()
    bands = [rng.normal(size=(*shape, max(num_states - d, 0))) - d for d in range(2 + num_skips)]
    chain = chain_of(bands, log_final=rng.normal(size=num_states))
    assert hmm.viterbi(ll, chain).starts.tolist() == hmm.viterbi(ll, chain, parallel=True).starts.tolist()
    rows, scan = hmm.smooth(ll, chain), hmm.smooth(ll, chain, parallel=True)
    np.testing.assert_allclose(rows.log_evidence, scan.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(rows.smoothed, scan.smoothed, atol=1e-10)
    np.testing.assert_allclose(rows.boundary, scan.boundary, atol=1e-10)


def test_missing_samples_are_no_evidence_and_nothing_underflows_or_overflows():
    ll, bands = random_problem(7, 3, seed=5)
    gone = ll.copy()
    gone[2:4] = np.nan
    empty = ll.copy()
    empty[2:4] = 0.0
    for chain in (chain_of(bands), chain_of((*bands, np.full((6, 1), -np.inf)))):
        assert hmm.viterbi(gone, chain).starts.tolist() == hmm.viterbi(empty, chain).starts.tolist()
        np.testing.assert_array_equal(hmm.smooth(gone, chain).smoothed, hmm.smooth(empty, chain).smoothed)
        ll[5, 1] = np.nan
        for function in (hmm.viterbi, hmm.smooth, hmm.log_evidence):
            refused(r"log_likelihoods: NaN or \+inf at \[5, 1\]", function, ll, chain, error=ValueError)
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
    trials = [rng.normal(size=(n, 4)).astype(kind) for n in (4, 9, 7, 5000)]
    chain = hmm.left_to_right([20.0, 5.0, 30.0, 10.0])
    for each, trial in zip(align(trials, [chain] * len(trials)), trials, strict=True):
        alone = hmm.viterbi(trial, chain)
        padded = np.concatenate([trial, np.full((3, 4), 7.0, kind)])
        assert hmm.viterbi(padded, chain, len(trial)).starts.tolist() == alone.starts.tolist()
        assert each.path.tolist() == alone.path.tolist() and each.log_prob == alone.log_prob
        np.testing.assert_array_equal(each.smoothed, hmm.smooth(trial, chain).smoothed)
    bad = [*trials, np.full((5, 4), -np.inf, kind)]
    refused("", align, bad, [chain] * len(bad), error=hmm.InfeasibleAlignment)
    bad[0] = trials[0].copy()
    bad[0][1, 2] = np.nan
    refused(r"log_likelihoods: NaN or \+inf at \[1, 2\]", align, bad, [chain] * len(bad), error=ValueError)


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
    crossed = moves[0][:, 1] + moves[1][:, :2].sum(1) + moves[2][:, 0]
    np.testing.assert_allclose(posterior.boundary[:, 1], crossed, atol=1e-12)
    # Without evidence, a recording of any length visits the states as often as was said.
    flat = hmm.smooth(np.zeros((400, 4)), chain)
    visits = flat.smoothed[0] + np.array([sum(m[:, k - d].sum() for d, m in enumerate(flat.moves, 1)
                                              if k >= d) for k in range(4)])  # fmt: skip
    np.testing.assert_allclose(visits, presence, atol=1e-9)


@pytest.mark.parametrize(("make", "message"), [
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
    (lambda: hmm.viterbi(np.zeros((3, 1)), hmm.left_to_right([1]), 4), "lengths: 4, expected 1 to 3"),
    (lambda: hmm.left_to_right([2.0, 3.0], [1.0]), r"presence: shape \(1,\), expected \(2,\)"),
    (lambda: hmm.left_to_right([2.0], [0.0]), r"probabilities in \(0, 1\]"),
    (lambda: hmm.smooth(np.full((3, 1), np.inf), hmm.left_to_right([1])), r"NaN or \+inf at \[0, 0\]"),
    (lambda: dense_viterbi(np.zeros((4, 2)), np.zeros(2), np.zeros(2)),
     r"log_transition: shape \(2,\), expected \(2, 2\)"),
    (lambda: dense_viterbi(np.full((4, 2), -np.inf), np.zeros(2), np.zeros((2, 2))), "no state path"),
    (lambda: dense_evidence(np.array([[0, 0], [0, np.nan]]), np.zeros(2), np.zeros((2, 2))),
     r"log_likelihoods: NaN at \[1, 1\]"),
    (lambda: hmm.DurationChain([]), "expected one array a state"),
    (lambda: hmm.DurationChain([np.zeros((2, 2))]), r"shape \(2, 2\) of state 0"),
    (lambda: hmm.DurationChain([np.zeros(2), np.full(3, -np.inf)]), "state 1, expected numbers or -inf"),
    (lambda: hmm.DurationChain([np.zeros(2)], [1.0, 1.0]), r"presence: shape \(2,\), expected \(1,\)"),
    (lambda: hmm.DurationChain([np.zeros(2)], [1.5]), r"probabilities in \(0, 1\]"),
    (lambda: hmm.DurationChain([np.zeros(2)], log_final=np.zeros(2)), r"log_final: shape \(2,\)"),
    (lambda: hmm.lasting([3.0], [0.0]), "above 0"),
    (lambda: hmm.StreamingFilter(hmm.lasting([3.0], [1.0]), 3), "tables of durations"),
    (lambda: hmm.smooth([[0.0, np.nan]], hmm.lasting([3.0, 2.0], [1.0, 1.0])), "NaN"),
    (lambda: hmm.filter(np.zeros((5, 2)), hmm.lasting([3.0, 2.0], [1.0, 1.0])), "tables of durations"),
    (lambda: hmm.StreamingFilter(hmm.left_to_right([2.0]), -1), "lag: -1"),
    (lambda: hmm.StreamingFilter(hmm.Chain(np.zeros((4, 2)), [0.0]), 3), "varies in time")])  # fmt: skip
def test_refusals(make, message):
    refused(message, make, error=ValueError)


@pytest.mark.parametrize("function", ["viterbi", "smooth", "filter", "log_evidence", "k_best", "sample"])
@pytest.mark.parametrize("num_skips", [0, 1])
def test_infeasible_alignments_say_which_subtask_starves(function, num_skips):
    ll, bands = random_problem(6, 3 + num_skips, seed=1, num_skips=num_skips)
    for band in bands[2:]:
        band[:] = -np.inf
    starved, dead_end = ll.copy(), ll.copy()
    starved[:, 1] = -np.inf
    dead_end[5, -1] = -np.inf
    for table, subtask, reason in [(starved, 1, "no sample is possible under it"),
                                   (dead_end, 2 + num_skips, "cannot be held to the end")]:  # fmt: skip
        with pytest.raises(hmm.InfeasibleAlignment, match=reason) as caught:
            getattr(hmm, function)(table, chain_of(bands),
                                   *{"k_best": (7,), "sample": (20_000,)}.get(function, ()))  # fmt: skip
        assert caught.value.subtask == subtask


# Inside other programs.


def ragged():
    """Three recordings of 8, 5 and 3 samples in one table, and a chain with a skip."""
    ll = np.random.default_rng(12).normal(size=(3, 8, 4))
    ll[1, 1] = np.nan  # missing
    chain = hmm.left_to_right([3.0, 2.0, 2.0, 4.0], [1.0, 0.5, 1.0, 1.0])
    return ll, np.array([8, 5, 3]), chain


@pytest.mark.parametrize("bits", [32, 64])
def test_jit_and_vmap_over_ragged_recordings_equal_one_by_one(bits):
    ll, lengths, chain = ragged()
    ll = ll.astype(np.float32).astype(float)
    with jax.enable_x64(bits == 64):
        x = jnp.asarray(ll, f"float{bits}")
        best = jax.jit(jax.vmap(hmm.viterbi, (0, None, 0)))(x, chain, lengths)
        soft = jax.vmap(jax.jit(hmm.smooth), (0, None, 0))(x, chain, lengths)
        assert soft.smoothed.dtype == x.dtype
    for i, n in enumerate(lengths):
        alone, posterior = hmm.viterbi(ll[i, :n], chain), hmm.smooth(ll[i, :n], chain)
        assert best.starts[i].tolist() == alone.starts.tolist()
        np.testing.assert_allclose(soft.smoothed[i, :n], posterior.smoothed, atol=1e-6 if bits == 32
                                   else 1e-12)  # fmt: skip
        assert (soft.smoothed[i, n:] == 0).all() and (soft.moves[0][i, n - 1 :] == 0).all()


@pytest.mark.parametrize("bits", [32, 64])
def test_the_gradient_of_the_log_evidence_is_the_posterior(bits):
    ll, lengths, chain = ragged()
    with jax.enable_x64(bits == 64):
        x = jnp.asarray(ll, f"float{bits}")

        def total(x, stay):
            each = hmm.Chain(stay, *chain.bands[1:2], chain.bands[2:], log_final=chain.log_final)
            return jax.vmap(hmm.log_evidence, (0, None, 0))(x, each, lengths).sum()

        by_x, by_stay = jax.jit(jax.grad(total, (0, 1)))(x, jnp.asarray(chain.bands[0], x.dtype))
        assert by_x.dtype == by_stay.dtype == x.dtype
    tolerance = 1e-5 if bits == 32 else 1e-10
    stays = np.zeros(4)
    for i, n in enumerate(lengths):
        posterior = hmm.smooth(ll[i, :n], chain)
        expected = np.where(np.isnan(ll[i, :n]), 0.0, posterior.smoothed)  # a missing row has no gradient
        np.testing.assert_allclose(by_x[i, :n], expected, atol=tolerance)
        assert (by_x[i, n:] == 0).all()
        stays += posterior.smoothed[:-1].sum(0) - sum(np.pad(m, ((0, 0), (0, d))).sum(0)
                                                      for d, m in enumerate(posterior.moves, 1))  # fmt: skip
    np.testing.assert_allclose(by_stay, stays, atol=10 * tolerance)


def test_inside_jit_what_is_impossible_is_minus_infinity():
    ll = np.zeros((6, 3))
    ll[:, 1] = -np.inf
    chain = hmm.left_to_right([2.0, 2.0, 2.0])
    assert jax.jit(hmm.viterbi)(ll, chain).log_prob == -np.inf
    assert jax.jit(hmm.log_evidence)(ll, chain) == -np.inf
    found, gradient = jax.jit(hmm.smooth)(ll, chain), jax.jit(jax.grad(hmm.log_evidence))(ll, chain)
    assert found.log_evidence == -np.inf and (found.smoothed == 0).all() and (gradient == 0).all()
    ll[2] = [0.0, np.nan, 0.0]  # no missing row: one that is broken
    assert np.isnan(jax.jit(hmm.log_evidence)(ll, chain))


def test_in_single_precision_a_long_recording_gets_its_labels():
    rng = np.random.default_rng(3)
    n, num_states = 1_000_000, 5
    mean = 0.05 * np.arange(num_states)
    y = mean[np.repeat(np.arange(num_states), n // num_states)] + rng.normal(size=n)
    ll = (-0.5 * (y[:, None] - mean) ** 2 - 10.0).astype(np.float32)
    chain = hmm.left_to_right([n / num_states] * num_states)
    reference = hmm.viterbi(ll.astype(float), chain).starts.tolist()
    assert hmm.viterbi(ll, chain).starts.tolist() == reference
    with jax.enable_x64(False):
        assert jax.jit(hmm.viterbi)(jnp.asarray(ll), chain).starts.tolist() == reference


def unordered(num_timesteps, num_states, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(num_timesteps, num_states)), rng.normal(size=num_states),
            rng.normal(size=(num_states, num_states)))  # fmt: skip


def every_path(ll, initial, transition):
    paths = list(itertools.product(range(ll.shape[1]), repeat=len(ll)))
    weights = [
        initial[p[0]] + sum(ll[t, k] for t, k in enumerate(p))
        + sum(transition[i, j] for i, j in itertools.pairwise(p))
        for p in paths]  # fmt: skip
    return paths, np.array(weights)


@pytest.mark.parametrize("size", [(1, 1), (1, 3), (5, 2), (6, 4)])
def test_unordered_chains_match_enumeration(size):
    ll, initial, transition = unordered(*size, seed=sum(size))
    if size[1] > 2:
        transition[0, 1] = initial[2] = -np.inf
    paths, weights = every_path(ll, initial, transition)
    best = dense_viterbi(ll, initial, transition)
    assert tuple(best.path.tolist()) == paths[weights.argmax()]
    np.testing.assert_allclose(best.log_prob, weights.max())
    np.testing.assert_allclose(dense_evidence(ll, initial, transition), np.logaddexp.reduce(weights))


def test_a_recording_may_begin_and_end_anywhere_and_rare_states_keep_their_evidence():
    ll, durations = lasting_problem(6, 3, seed=8)
    durations = [np.append(table, np.zeros(6 - table.size)) for table in durations]
    ends = {"initial": np.array([0.0, -1.0, -np.inf]), "final": np.array([-np.inf, 0.5, -2.0])}
    starts, weights = enumerate_paths(ll, durations, np.ones(3), False, **ends)
    chain = hmm.DurationChain(durations, log_initial=ends["initial"], log_final=ends["final"])
    keep = np.isfinite(weights)
    assert hmm.viterbi(ll, chain).starts.tolist() == starts[weights.argmax()].tolist()
    np.testing.assert_allclose(hmm.log_evidence(ll, chain), np.logaddexp.reduce(weights[keep]))
    ll, initial, transition = unordered(40, 3)
    ll[:, 1] = -1e3
    initial[[0, 2]] = -np.inf
    transition[1, [0, 2]] = -np.inf
    alone = initial[1] + ll[:, 1].sum() + 39 * transition[1, 1]
    np.testing.assert_allclose(dense_evidence(ll, initial, transition), alone)
    assert (dense_viterbi(ll, initial, transition).path == 1).all()


def crossing(moves, num_states):
    """Probability [t, k] that states up to k end between t and t + 1."""
    out = np.zeros((len(moves[0]), num_states - 1))
    for d, band in enumerate(moves, 1):
        for k in range(band.shape[1]):
            out[:, k : k + d] += band[:, k, None]
    return out


@pytest.mark.parametrize(("lag", "num_skips"), [(0, 1), (3, 0), (3, 1), (20, 0)])
def test_every_step_matches_enumeration(lag, num_skips):
    rng = np.random.default_rng(0)
    rows = [rng.normal(size=max(3 - d, 0)) - d for d in range(2 + num_skips)]
    ll = rng.normal(size=(8, 3)) * 2
    chain = hmm.Chain(rows[0], rows[1], rows[2:] or None)
    stream = hmm.StreamingFilter(chain, lag)
    for t, row in enumerate(ll):
        step, bands = stream.update(row), [np.tile(r, (t, 1)) for r in rows]
        *_, log_evidence, smoothed, moves = brute(ll[: t + 1], bands, final=np.zeros(3))
        assert step.sample == t
        np.testing.assert_allclose(step.log_evidence, log_evidence)
        np.testing.assert_allclose(step.filtered, smoothed[-1], atol=1e-12)
        assert (step.smoothed is None) == (t < lag)
        crossed = np.vstack([np.zeros((1, 2)), crossing(moves, 3)])
        if t >= lag:
            np.testing.assert_allclose(step.smoothed, smoothed[t - lag], atol=1e-12)
            np.testing.assert_allclose(step.boundary, crossed[t - lag], atol=1e-12)
        window = stream.window()
        assert window.first == max(t - lag, 0)
        np.testing.assert_allclose(window.smoothed, smoothed[window.first :], atol=1e-12)
        np.testing.assert_allclose(window.boundary, crossed[window.first :], atol=1e-12)
    *_, smoothed, moves = brute(ll, [np.tile(r, (7, 1)) for r in rows])
    rest = stream.finish()
    assert rest.first == max(8 - lag, 0)
    np.testing.assert_allclose(rest.smoothed, smoothed[rest.first :], atol=1e-12)
    if lag:
        crossed = np.vstack([np.zeros((1, 2)), crossing(moves, 3)])
        np.testing.assert_allclose(rest.boundary, crossed[rest.first :], atol=1e-12)


@pytest.mark.parametrize(("num_states", "optional"), [(1, False), (9, True)])
def test_a_long_stream_equals_the_recording(num_states, optional):
    rng = np.random.default_rng(num_states)
    n, lag = 600, 40
    ll = rng.normal(size=(n, num_states)) - 50.0  # log weights sink by 3e4
    ll[np.arange(n), np.arange(n) * num_states // n] += 1.0
    ll[200:220] = np.nan
    presence = [0.9 if optional and k == 2 else 1.0 for k in range(num_states)]
    chain = hmm.left_to_right([n / num_states] * num_states, presence)
    stream = hmm.StreamingFilter(chain, lag)
    held = [v.nbytes for v in vars(stream).values() if isinstance(v, np.ndarray)]
    steps, offline = [stream.update(row) for row in ll], hmm.filter(ll, chain)
    np.testing.assert_allclose([s.filtered for s in steps], offline.filtered, atol=1e-9)
    np.testing.assert_allclose(stream.finish().smoothed, hmm.smooth(ll, chain).smoothed[-lag:], atol=1e-9)
    assert [v.nbytes for v in vars(stream).values() if isinstance(v, np.ndarray)] == held
    # Whoever waits long enough agrees with the whole recording where it is not near its end.
    patient = hmm.StreamingFilter(chain, 300)
    late = np.array([s.smoothed for s in (patient.update(row) for row in ll) if s.smoothed is not None])
    np.testing.assert_allclose(late[:250], hmm.smooth(ll, chain).smoothed[:250], atol=1e-6)


@pytest.mark.parametrize("presence", [None, [1.0, 0.5, 1.0]])
def test_a_refused_sample_leaves_the_stream_as_it_was(presence):
    chain = hmm.left_to_right([2.0, 2.0, 2.0], presence)
    ll = np.random.default_rng(1).normal(size=(5, 3))
    clean, stream = hmm.StreamingFilter(chain, 1), hmm.StreamingFilter(chain, 1)
    refused("no sample has come", stream.window, error=ValueError)
    wrong = (([-np.inf] * 3, "no state is possible at sample"), ([0.0, np.nan, 0.0], "NaN throughout"),
             ([0.0, np.inf, 0.0], "expected numbers"), ([0.0, 1.0], r"shape \(2,\), expected"))  # fmt: skip
    for row in ll:
        expected = clean.update(row)
        for bad, line in wrong:
            kind = hmm.InfeasibleAlignment if "state" in line else ValueError
            refused(line, stream.update, bad, error=kind)
        np.testing.assert_array_equal(stream.update(row).filtered, expected.filtered)
    early = hmm.StreamingFilter(hmm.left_to_right([2.0, 2.0, 2.0]), 1)
    early.update([0.0, 0.0, 0.0])
    refused("cannot be held to the end", early.finish, error=hmm.InfeasibleAlignment)


def enumerate_paths(ll, durations, presence, open_end, initial=None, final=None):
    """First samples of all states and log weights of all paths, straight from the definition."""
    num_rows, num_states = ll.shape
    starts, weights = [], []
    with np.errstate(divide="ignore"):
        present, absent = np.log(presence), np.log1p(-np.array(presence))
    for size in range(1, num_states + 1):
        for visited in itertools.combinations(range(num_states), size):
            for cuts in itertools.combinations(range(1, num_rows), size - 1):
                edges = (0, *cuts, num_rows)
                missed = [k for k in range(num_states) if k not in visited]
                before = [k for k in missed if k < visited[0]]
                after = [k for k in missed if k > visited[-1]]
                weight = absent[[k for k in missed if k not in before and k not in after]].sum()
                weight += present[list(visited[1:])].sum()
                first = absent[before].sum() + present[visited[0]] if initial is None else initial[visited[0]]
                weight += first + (absent[after].sum() if final is None else final[visited[-1]])
                for k, (a, b) in zip(visited, itertools.pairwise(edges), strict=True):
                    table = np.append(durations[k], np.full(num_rows + 1, -np.inf))
                    cut = open_end and b == num_rows
                    lasts = np.logaddexp.reduce(table[b - a - 1 :]) if cut else table[b - a - 1]
                    weight += lasts + ll[a:b, k].sum()
                if weight == -np.inf:
                    continue
                row = np.full(num_states, num_rows)
                for k, a in zip(visited, edges[:-1], strict=True):
                    row[k] = a
                starts.append(np.minimum.accumulate(row[::-1])[::-1])
                weights.append(weight)
    return np.array(starts), np.array(weights)


def lasting_problem(num_rows, num_states, seed):
    rng = np.random.default_rng(seed)
    durations = [rng.normal(size=rng.integers(1, num_rows + 1)) - 1 for _ in range(num_states)]
    durations[0][0] = -np.inf if durations[0].size > 1 else 0.0  # some durations are impossible
    # One length of tables a size, so that one program does all.
    durations[-1] = np.append(durations[-1], np.full(num_rows - durations[-1].size, -5.0))
    return 2 * rng.normal(size=(num_rows, num_states)), durations


@pytest.mark.parametrize("open_end", [False, True])
@pytest.mark.parametrize("optional", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (8, 3), (7, 4)])
def test_every_quantity_matches_enumeration_of_durations(size, optional, open_end):
    for seed in range(20):  # the first random tables that allow any path
        ll, durations = lasting_problem(*size, seed=sum(size) + 100 * seed)
        presence = np.array([1.0, 0.6, 0.3, 0.8][: size[1]]) if optional else np.ones(size[1])
        ll[size[0] // 2] = np.nan if size[0] > 2 else 0.0  # a missing sample
        x = np.nan_to_num(ll)
        starts, weights = enumerate_paths(x, durations, presence, open_end)
        if len(weights):
            break
    chain = hmm.DurationChain(durations, presence, open_end=open_end)
    log_evidence = np.logaddexp.reduce(weights)
    p, lengths = np.exp(weights - log_evidence), np.diff(starts, axis=1, append=len(ll))
    states = np.array([np.repeat(np.arange(size[1]), row) for row in lengths])
    np.testing.assert_allclose(hmm.log_evidence(ll, chain), log_evidence, rtol=1e-12)
    best = hmm.viterbi(ll, chain)
    assert best.starts.tolist() == starts[weights.argmax()].tolist()
    np.testing.assert_allclose(best.log_prob, weights.max(), rtol=1e-12)
    ranked, order = hmm.k_best(ll, chain, 9), np.argsort(-weights)[:9]
    np.testing.assert_allclose(ranked.log_prob, weights[order], rtol=1e-11)
    assert ranked.starts.tolist() == starts[order].tolist()
    posterior = hmm.smooth(ll, chain)
    np.testing.assert_allclose(posterior.log_evidence, log_evidence, rtol=1e-12)
    smoothed = np.array([[p[states[:, t] == k].sum() for k in range(size[1])] for t in range(len(ll))])
    np.testing.assert_allclose(posterior.smoothed, smoothed, atol=1e-12)
    for d, moves in enumerate(posterior.moves, 1):
        expected = [[p[(states[:, t] == k) & (states[:, t + 1] == k + d)].sum() for k in range(size[1] - d)]
                    for t in range(len(ll) - 1)]  # fmt: skip
        np.testing.assert_allclose(moves, np.reshape(expected, moves.shape), atol=1e-12)


def test_draws_have_the_exact_path_probabilities_of_durations():
    ll, durations = lasting_problem(6, 3, seed=3)
    durations = [np.append(table, np.zeros(6 - table.size)) for table in durations]
    presence = np.array([0.7, 0.5, 0.8])
    starts, weights = enumerate_paths(ll, durations, presence, False)
    drawn = hmm.sample(ll, hmm.DurationChain(durations, presence), 20_000, seed=5).starts
    counts = np.array([(drawn == row).all(axis=1).sum() for row in starts])
    assert_drawn(counts, np.exp(weights - np.logaddexp.reduce(weights)) * len(drawn))


def test_tables_of_lasting_have_their_moments_and_decide_where_samples_do_not():
    chain = hmm.lasting([30.0, 10.0], [2.0, 2.0])
    found = hmm.viterbi([np.zeros((40, 2)), np.zeros((37, 2))], chain)
    assert found.num_samples.tolist() == [40, 37]
    assert abs(found.starts[0, 1] - 30) <= 1 and abs(found.starts[1, 1] - 28.5) <= 1.5
    interval = hmm.smooth(np.zeros((40, 2)), chain).start_intervals(0.9)[0]
    np.testing.assert_allclose(interval, [30 - 2.3, 30 + 2.3], atol=1.0)  # sd 2 / sqrt(2)
    chain = hmm.lasting([50.0, 200.0], [10.0, 5.0])
    n, p = np.arange(1, chain.pmf.shape[1] + 1), np.exp(chain.pmf)
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    np.testing.assert_allclose(p @ n, [50.0, 200.0], rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(p @ n**2 - (p @ n) ** 2), [10.0, 5.0], rtol=1e-2)


def test_no_path_names_the_state():
    chain = hmm.DurationChain([np.zeros(3), np.zeros(3)])
    with pytest.raises(hmm.InfeasibleAlignment) as caught:
        hmm.viterbi(np.zeros((9, 2)), chain)  # six samples at most
    assert caught.value.subtask == 1
    bad = np.zeros((4, 2))
    bad[0, 0] = -np.inf
    for ask in (hmm.viterbi, hmm.smooth, hmm.log_evidence):
        with pytest.raises(hmm.InfeasibleAlignment) as caught:
            ask(bad, chain)
        assert caught.value.subtask == 0
