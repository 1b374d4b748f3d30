"""The separate scorer: opens the seal, checks the hash, and computes every figure of the goals."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from experiments.blind_check.judge import judge_case
from experiments.blind_check.sealing import unseal

# Figures with their 95 % intervals: proportions, means, calibration, F1.

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


# The figures of a set.

Row = dict[str, Any]
SIZES = (0.0, 0.1, 0.3, 1.0)
# Figures that are also given by bracket of every circumstance.
BRACKETED = ("false_alarms", "named_right", "outside_right")


def score(folder: Path, results: Path, ranges: Sequence[tuple[int, int]] = ()) -> dict[str, Any]:
    """All figures of a sealed set. BrokenSeal where labels changed, ValueError where results lack.

    `ranges` [from, to) judges those cases only, for a run that its time cut short: numbers tell nothing.
    """
    rows = []
    every = unseal(folder)["cases"]
    chosen = [entry for a, b in ranges for entry in every[a:b]] if ranges else every
    for entry in chosen:
        file = results / f"{entry['case']}.json"
        if not file.exists():
            raise ValueError(f"{file}: no result; run diagnose to the end first, or give --only")
        rows.append(judge_case(entry, json.loads(file.read_text(encoding="utf-8"))))
    code = json.loads((results / "code.json").read_text(encoding="utf-8"))["sha256"]
    seal = json.loads((folder / "seal.json").read_text(encoding="utf-8"))
    return {"seal": seal, "code": code, **figures(rows)}


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """The figures of the goals over all worlds, by bracket, by size and by effect, and the rows."""
    tiers = list(dict.fromkeys(r["tier"] for r in rows))
    return {
        "cases": {t: sum(r["tier"] == t for r in rows) for t in tiers},
        "table": {name: figure(rows) for name, figure in FIGURES.items()},
        "brackets": _brackets(rows),
        "by_size": [
            {"from": low, "to": high, "named": proportion([r["right"] for r in _sized(rows, low, high)])}
            for low, high in pairwise(SIZES)
        ],
        "by_effect": {
            e: proportion([r["right"] for r in _above(rows, "single") if r["true"] == [e]])
            for e in sorted({r["true"][0] for r in rows if r["tier"] == "single"})
        },
        "rows": list(rows),
    }


def _tier(rows: Sequence[Row], *names: str) -> list[Row]:
    return [r for r in rows if r["tier"] in names]


def _above(rows: Sequence[Row], *names: str) -> list[Row]:
    """Rows of some tiers whose effects are detectable."""
    return [r for r in _tier(rows, *names) if r["above"]]


def _sized(rows: Sequence[Row], low: float, high: float) -> list[Row]:
    return [r for r in _tier(rows, "single", "small") if low < max(r["sizes"].values()) <= high]


def _small(rows: Sequence[Row]) -> list[Row]:
    return [r for r in _tier(rows, "single", "small") if not r["above"]]


FIGURES: dict[str, Callable[[Sequence[Row]], dict[str, Any]]] = {
    "false_alarms": lambda rows: proportion([r["verdict"] != "none" for r in _tier(rows, "healthy")]),
    "slight_none": lambda rows: proportion([r["right"] for r in _tier(rows, "slight")]),
    "named_right": lambda rows: proportion([r["right"] for r in _above(rows, "single")]),
    "set_right": lambda rows: proportion([r["right_set"] for r in _above(rows, "single")]),
    "probability_of_true": lambda rows: mean([r["probability"] for r in _above(rows, "single")]),
    "calibration_error": lambda rows: calibration([[r["top"]] for r in rows if r["top"] is not None]),
    "outside_right": lambda rows: proportion([r["right"] for r in _above(rows, "outside")]),
    "withheld_right": lambda rows: proportion([r["right"] for r in _above(rows, "withheld")]),
    "pair_both": lambda rows: proportion([r["right"] for r in _above(rows, "pair")]),
    "dense_dominant": lambda rows: proportion([r["dominant"] for r in _tier(rows, "dense")]),
    "inclusion_dense": lambda rows: calibration([r["inclusion"] for r in _tier(rows, "dense")]),
    "inclusion_all": lambda rows: calibration([r["inclusion"] for r in rows]),
    "coverage_dense": lambda rows: clustered(
        [list(r["covered"].values()) for r in _tier(rows, "dense") if "covered" in r]
    ),
    "coverage_90": lambda rows: clustered([list(r["covered"].values()) for r in rows if "covered" in r]),
    "location_f1": lambda rows: f1([tuple(r["cells"].values()) for r in rows]),  # type: ignore[misc]
    "known_rejected": lambda rows: proportion([r["verdict"] == "unknown" for r in _above(rows, "single")]),
    "small_none": lambda rows: proportion([r["verdict"] == "none" for r in _small(rows)]),
    "bic_named": lambda rows: proportion([r["bic"] == r["true"][0] for r in _above(rows, "single")]),
    "bic_alarms": lambda rows: proportion([r["bic"] != "none" for r in _tier(rows, "healthy")]),
    "errors": lambda rows: proportion([r["verdict"] == "error" for r in rows]),
    "seconds": lambda rows: mean([r["seconds"] for r in rows], statistic=np.median),
}


def _brackets(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """By circumstance and bracket, the figures that no single world may fail."""
    out: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(k for r in rows for k in r["brackets"]):
        out[name] = {
            bracket: {f: FIGURES[f]([r for r in rows if r["brackets"][name] == bracket]) for f in BRACKETED}
            for bracket in sorted({r["brackets"][name] for r in rows})
        }
    return out
