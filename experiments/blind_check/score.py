"""The separate scorer: opens the seal, checks the hash, compares, writes every figure of the goals."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.blind_check.judge import judge_case
from experiments.blind_check.sealing import unseal
from experiments.blind_check.statistics import calibration, clustered, f1, mean, proportion

Row = dict[str, Any]
SIZES = (0.0, 0.1, 0.3, 1.0)
# What is given by bracket of every circumstance too.
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
    """The table of the goals on all worlds pooled, by bracket, by size and effect, and the rows."""
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
    """Those of some tiers whose effects can be seen."""
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
