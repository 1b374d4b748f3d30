"""The likelihood by parts against the whole covariance, and its slopes against differences."""

from __future__ import annotations

import numpy as np
import pytest

from simgap.robots.tied import Tied
from simgap.robots.whiten import Block, Discrepancy, Source

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
def test_parts_make_the_whole(states, across):
    one, residual = block(states, across)
    variance = np.array([0.7, 0.2, 1.5, 0.4, 9.0])
    tied = Tied.of(one, residual, NAMES)
    assert len(tied.parts) == (1 if across else 2) and tied.square == pytest.approx(residual @ residual)
    whole = one.covariance(Discrepancy(dict(zip(NAMES, np.sqrt(variance), strict=True))))
    found = tied.solved(variance)
    assert found.square == pytest.approx(residual @ np.linalg.solve(whole, residual), rel=1e-10)
    assert found.half == pytest.approx(0.5 * np.linalg.slogdet(whole)[1], rel=1e-10)
    trace, pull = found.slopes()
    inverse = np.linalg.inv(whole)
    for k, name in enumerate(NAMES):
        each = np.zeros((12, 12))
        if name in one.sources:
            one.sources[name].add(each, 1.0)
        assert tied.trace[k] == pytest.approx(np.trace(each))
        assert trace[k] == pytest.approx(np.sum(inverse * each), rel=1e-9)
        assert pull[k] == pytest.approx(residual @ inverse @ each @ inverse @ residual, rel=1e-9)


def test_noise_lost_in_rounding_is_said():
    one, residual = block(2, False)
    even = Source(np.flatnonzero(np.arange(12) % 2), np.ones((6, 6)))
    one = Block(one.rows, 3, one.variance, one.start, {"a": even})
    with pytest.raises(np.linalg.LinAlgError):
        Tied.of(one, residual, ("a",)).solved(np.array([1e40]))
