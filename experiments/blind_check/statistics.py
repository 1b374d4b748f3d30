"""Figures with their 95 % intervals: proportions, means, calibration, F1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

BINS = 10
DRAWS = 2000
NOTHING: dict[str, Any] = {"count": 0, "value": None, "interval_95": None}


def proportion(flags: Sequence[bool]) -> dict[str, Any]:
    """A proportion with its exact binomial interval (Clopper & Pearson, Biometrika 26, 1934)."""
    n, k = len(flags), int(sum(flags))
    if n == 0:
        return NOTHING
    ends = binomtest(k, n).proportion_ci(0.95, "exact")
    return {"count": n, "hits": k, "value": k / n, "interval_95": [float(ends.low), float(ends.high)]}


def mean(values: Sequence[float], statistic: Callable = np.mean) -> dict[str, Any]:
    """A mean (or another statistic) over cases with its bootstrap interval."""
    if not len(values):
        return NOTHING
    x = np.array(values, float)
    return _bootstrapped(lambda rows: float(statistic(x[rows])), x.size)


def clustered(groups: Sequence[Sequence[bool]]) -> dict[str, Any]:
    """A proportion of flags that come in clusters (cases), with its bootstrap interval over clusters."""
    groups = [g for g in groups if len(g)]
    if not groups:
        return NOTHING
    hits, sizes = np.array([sum(g) for g in groups]), np.array([len(g) for g in groups])
    found = _bootstrapped(lambda rows: float(hits[rows].sum() / sizes[rows].sum()), len(groups))
    return found | {"cases": len(groups), "count": int(sizes.sum())}


def calibration(groups: Sequence[Sequence[tuple[float, bool]]]) -> dict[str, Any]:
    """Expected calibration error of (probability, whether it came true) in BINS of equal width, cases as
    clusters.
    """
    groups = [g for g in groups if len(g)]
    if not groups:
        return NOTHING | {"bins": []}
    sums = np.zeros((len(groups), BINS, 3))  # count, said, true
    for k, group in enumerate(groups):
        for p, right in group:
            sums[k, min(int(p * BINS), BINS - 1)] += (1.0, p, right)

    def error(rows: np.ndarray) -> float:
        total = sums[rows].sum(0)
        return float(np.abs(total[:, 2] - total[:, 1]).sum() / max(total[:, 0].sum(), 1))

    total = sums.sum(0)
    bins = [{"count": int(n), "said": float(s / n), "true": float(r / n)} for n, s, r in total if n]
    return _bootstrapped(error, len(groups)) | {"count": int(total[:, 0].sum()), "bins": bins}


def f1(counts: Sequence[tuple[int, int, int]]) -> dict[str, Any]:
    """F1 over all cells of the cases: (hit, false, missed) of each."""
    c = np.array(counts)
    if not c.size or not c.sum():
        return NOTHING

    def score(rows: np.ndarray) -> float:
        hit, false, missed = c[rows].sum(0)
        return float(2 * hit / max(2 * hit + false + missed, 1))

    hit, false, missed = (int(v) for v in c.sum(0))
    more = {"precision": hit / max(hit + false, 1), "recall": hit / max(hit + missed, 1)}
    return _bootstrapped(score, len(c)) | more


def _bootstrapped(statistic: Callable[[np.ndarray], float], n: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    draws = [statistic(rng.integers(0, n, n)) for _ in range(DRAWS)]
    low, high = np.percentile(draws, (2.5, 97.5))
    return {"count": n, "value": statistic(np.arange(n)), "interval_95": [float(low), float(high)]}
