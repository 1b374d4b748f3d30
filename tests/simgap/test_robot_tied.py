"""The likelihood by parts against the whole covariance, and its slopes against differences."""

from __future__ import annotations

import numpy as np
import pytest

from simgap.robots import triangular
from simgap.robots.blocks import Block, Discrepancy, Source
from simgap.robots.tied import Tied

NAMES = ("a", "b", "clock", "both", "absent")


def block(states: int, across: bool) -> tuple[Block, np.ndarray]:
    """Two channels of 5 and 7 rows, taking turns at first; `across`: a source that ties them."""
    rng = np.random.default_rng(4)
    channel = np.array([0, 1] * 5 + [1, 1])
    sources = {}
    for k, name in enumerate("ab"):
        rows = np.flatnonzero(channel == k)
        half = rng.standard_normal((rows.size, rows.size))
        sources[name] = Source(rows, half @ half.T)
    sources["clock"] = Source(np.arange(12), rng.uniform(0.1, 1.0, 12))
    if across:
        rows = np.array([0, 3, 11])
        sources["both"] = Source(rows, np.ones((3, 3)) + np.eye(3))
    start = 3 * rng.standard_normal((12, states))
    return Block(np.arange(20, 32), 3, rng.uniform(0.5, 2.0, 12), start, sources), rng.standard_normal(12)


@pytest.mark.parametrize("states", [0, 2])
@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("large", [1, 100])
def test_parts_make_the_whole(states, across, large, monkeypatch):
    monkeypatch.setattr(triangular, "LARGE", large)
    one, residual = block(states, across)
    other = Block(np.arange(12), 4, 2 * one.variance, one.start[:, : max(states - 1, 0)], one.sources)
    of_rows = np.concatenate([residual[::-1], np.zeros(8), residual])
    variance = np.array([0.7, 0.2, 1.5, 0.4, 9.0])
    tied = Tied.of([one, other], NAMES)
    assert sum(len(stack.rows) for stack in tied.stacks) == (2 if across else 4)
    likelihood = tied.of_residual(of_rows)
    np.testing.assert_allclose(likelihood.squares, residual @ residual)
    value, slope = likelihood.slope(variance)
    expected, slopes = 0.0, np.zeros(len(NAMES))
    for number, each in enumerate((one, other)):
        mine = of_rows[each.rows]
        whole = each.covariance(Discrepancy(dict(zip(NAMES, np.sqrt(variance), strict=True))))
        inverse = np.linalg.inv(whole)
        expected += 0.5 * (mine @ inverse @ mine + np.linalg.slogdet(whole)[1])
        for k, name in enumerate(NAMES):
            q = np.zeros((12, 12))
            if name in each.sources:
                each.sources[name].add(q, 1.0)
            assert tied.trace[number, k] == pytest.approx(np.trace(q))
            slopes[k] += 0.5 * (np.sum(inverse * q) - mine @ inverse @ q @ inverse @ mine)
    assert value == pytest.approx(expected, rel=1e-10) == likelihood.value(variance)
    np.testing.assert_allclose(slope, slopes, rtol=1e-9, atol=1e-9)


def test_noise_lost_in_rounding_is_said():
    one, residual = block(2, False)
    even = Source(np.flatnonzero(np.arange(12) % 2), np.ones((6, 6)))
    one = Block(np.arange(12), 3, one.variance, one.start, {"a": even})
    with pytest.raises(np.linalg.LinAlgError):
        Tied.of([one], ("a",)).of_residual(residual).value(np.array([1e40]))
