"""States with tables of durations against enumeration of every path, and against what they generalise."""

import itertools

import numpy as np
import pytest
from scipy.stats import chisquare

import hmmseg.hmm as hmm


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


def states_of(starts, num_rows):
    lengths = np.diff(starts, axis=1, append=num_rows)
    return np.array([np.repeat(np.arange(starts.shape[1]), row) for row in lengths])


def problem(num_rows, num_states, seed):
    rng = np.random.default_rng(seed)
    durations = [rng.normal(size=rng.integers(1, num_rows + 1)) - 1 for _ in range(num_states)]
    durations[0][0] = -np.inf if durations[0].size > 1 else 0.0  # some durations are impossible
    # One length of tables a size, so that one program does all.
    durations[-1] = np.append(durations[-1], np.full(num_rows - durations[-1].size, -5.0))
    return 2 * rng.normal(size=(num_rows, num_states)), durations


@pytest.mark.parametrize("open_end", [False, True])
@pytest.mark.parametrize("optional", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (6, 2), (8, 3), (7, 4)])
def test_every_quantity_matches_enumeration(size, optional, open_end):
    for seed in range(20):  # the first random tables that allow any path
        ll, durations = problem(*size, seed=sum(size) + 100 * seed)
        presence = np.array([1.0, 0.6, 0.3, 0.8][: size[1]]) if optional else np.ones(size[1])
        ll[size[0] // 2] = np.nan if size[0] > 2 else 0.0  # a missing sample
        x = np.nan_to_num(ll)
        starts, weights = enumerate_paths(x, durations, presence, open_end)
        if len(weights):
            break
    chain = hmm.DurationChain(durations, presence, open_end=open_end)
    log_evidence = np.logaddexp.reduce(weights)
    p, states = np.exp(weights - log_evidence), states_of(starts, len(ll))
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


def test_where_a_recording_may_begin_and_end():
    ll, durations = problem(6, 3, seed=8)
    durations = [np.append(table, np.zeros(6 - table.size)) for table in durations]
    ends = {"initial": np.array([0.0, -1.0, -np.inf]), "final": np.array([-np.inf, 0.5, -2.0])}
    starts, weights = enumerate_paths(ll, durations, np.ones(3), False, **ends)
    chain = hmm.DurationChain(durations, log_initial=ends["initial"], log_final=ends["final"])
    keep = np.isfinite(weights)
    assert hmm.viterbi(ll, chain).starts.tolist() == starts[weights.argmax()].tolist()
    np.testing.assert_allclose(hmm.log_evidence(ll, chain), np.logaddexp.reduce(weights[keep]))


def test_draws_have_the_exact_path_probabilities():
    ll, durations = problem(6, 3, seed=3)
    durations = [np.append(table, np.zeros(6 - table.size)) for table in durations]
    presence = np.array([0.7, 0.5, 0.8])
    starts, weights = enumerate_paths(ll, durations, presence, False)
    drawn = hmm.sample(ll, hmm.DurationChain(durations, presence), 20_000, seed=5).starts
    p = np.exp(weights - np.logaddexp.reduce(weights))
    counts = np.array([(drawn == row).all(axis=1).sum() for row in starts])
    assert counts.sum() == len(drawn)
    often = p * len(drawn) > 5
    observed = np.append(counts[often], counts[~often].sum())
    expected = np.append(p[often], p[~often].sum()) * len(drawn)
    assert chisquare(observed[expected > 0], expected[expected > 0]).pvalue > 1e-3


def test_durations_decide_where_samples_do_not():
    """Two states alike but for how long they last; several recordings of different lengths in one call."""
    chain = hmm.lasting([30.0, 10.0], [2.0, 2.0])
    found = hmm.viterbi([np.zeros((40, 2)), np.zeros((37, 2))], chain)
    assert found.num_samples.tolist() == [40, 37]
    assert abs(found.starts[0, 1] - 30) <= 1 and abs(found.starts[1, 1] - 28.5) <= 1.5
    interval = hmm.smooth(np.zeros((40, 2)), chain).start_intervals(0.9)[0]
    np.testing.assert_allclose(interval, [30 - 2.3, 30 + 2.3], atol=1.0)  # sd 2 / sqrt(2)


def test_tables_of_lasting_have_their_moments():
    chain = hmm.lasting([50.0, 200.0], [10.0, 5.0])
    n = np.arange(1, chain.pmf.shape[1] + 1)
    p = np.exp(chain.pmf)
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    np.testing.assert_allclose(p @ n, [50.0, 200.0], rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(p @ n**2 - (p @ n) ** 2), [10.0, 5.0], rtol=1e-2)


@pytest.mark.parametrize(("make", "said"), [
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
])  # fmt: skip
def test_what_cannot_be_is_said(make, said):
    with pytest.raises(ValueError, match=said):
        make()


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
