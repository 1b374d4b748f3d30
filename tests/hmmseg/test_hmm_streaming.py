"""The stream against enumeration of every path of what has come so far."""

import numpy as np
import pytest
from path_enumeration import brute

import hmmseg.hmm as hmm


def problem(num_skips, n=8, num_states=3, seed=0):
    rng = np.random.default_rng(seed)
    rows = [rng.normal(size=max(num_states - d, 0)) - d for d in range(2 + num_skips)]
    return rng.normal(size=(n, num_states)) * 2, rows


def crossing(moves, num_states):
    """Probability [t, k] that states up to k end between t and t + 1."""
    out = np.zeros((len(moves[0]), num_states - 1))
    for d, band in enumerate(moves, 1):
        for k in range(band.shape[1]):
            out[:, k : k + d] += band[:, k, None]
    return out


@pytest.mark.parametrize("num_skips", [0, 1])
@pytest.mark.parametrize("lag", [0, 3, 20])
def test_every_step_matches_enumeration(lag, num_skips):
    ll, rows = problem(num_skips)
    chain = hmm.Chain(rows[0], rows[1], rows[2:] or None)
    stream = hmm.StreamingFilter(chain, lag)
    for t, row in enumerate(ll):
        step = stream.update(row)
        bands = [np.tile(r, (t, 1)) for r in rows]
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
    steps = [stream.update(row) for row in ll]
    offline = hmm.filter(ll, chain)
    np.testing.assert_allclose([s.filtered for s in steps], offline.filtered, atol=1e-9)
    np.testing.assert_allclose(stream.finish().smoothed, hmm.smooth(ll, chain).smoothed[-lag:], atol=1e-9)
    # Whoever waits long enough agrees with the whole recording where it is not near its end.
    patient = hmm.StreamingFilter(chain, 300)
    late = np.array([s.smoothed for s in (patient.update(row) for row in ll) if s.smoothed is not None])
    np.testing.assert_allclose(late[:250], hmm.smooth(ll, chain).smoothed[:250], atol=1e-6)


def test_memory_does_not_grow():
    stream = hmm.StreamingFilter(hmm.left_to_right([50.0, 50.0, 50.0]), 10)
    sizes = [v.nbytes for v in vars(stream).values() if isinstance(v, np.ndarray)]
    for row in np.random.default_rng(0).normal(size=(100, 3)):
        stream.update(row)
    assert [v.nbytes for v in vars(stream).values() if isinstance(v, np.ndarray)] == sizes
    assert sum(sizes) < 2_000


@pytest.mark.parametrize("presence", [None, [1.0, 0.5, 1.0]])
def test_a_refused_sample_leaves_the_stream_as_it_was(presence):
    chain = hmm.left_to_right([2.0, 2.0, 2.0], presence)
    ll = np.random.default_rng(1).normal(size=(5, 3))
    clean, stream = hmm.StreamingFilter(chain, 1), hmm.StreamingFilter(chain, 1)
    with pytest.raises(ValueError, match="no sample has come"):
        stream.window()
    for row in ll:
        expected = clean.update(row)
        with pytest.raises(hmm.InfeasibleAlignment, match="no state is possible at sample"):
            stream.update(np.full(3, -np.inf))
        with pytest.raises(ValueError, match="missing: NaN throughout"):
            stream.update([0.0, np.nan, 0.0])
        with pytest.raises(ValueError, match="expected numbers"):
            stream.update([0.0, np.inf, 0.0])
        with pytest.raises(ValueError, match=r"shape \(2,\), expected \(3,\)"):
            stream.update([0.0, 1.0])
        np.testing.assert_array_equal(stream.update(row).filtered, expected.filtered)
    early = hmm.StreamingFilter(hmm.left_to_right([2.0, 2.0, 2.0]), 1)
    early.update([0.0, 0.0, 0.0])
    with pytest.raises(hmm.InfeasibleAlignment, match="cannot be held to the end"):
        early.finish()


def test_refusals():
    with pytest.raises(ValueError, match="lag: -1"):
        hmm.StreamingFilter(hmm.left_to_right([2.0]), -1)
    with pytest.raises(ValueError, match="varies in time"):
        hmm.StreamingFilter(hmm.Chain(np.zeros((4, 2)), [0.0]), 3)
