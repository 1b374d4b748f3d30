"""From the units of a sweep to its results: every measure of every method in every cell.

A method that finds nothing where something was is counted as infinitely wrong there, so medians
and percentiles are over all trials; an infinite one is null. Intervals are 95 % bootstrap
intervals over trials.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.sweeps.cells import SWEEPS, THRESHOLDS, Unit
from experiments.sweeps.methods import PROPERTIES
from experiments.sweeps.store import Store

RESAMPLES = 400
QUANTILES = (0.05, 0.5, 0.95)
DIAGONAL = [i * len(THRESHOLDS) + i for i in range(len(THRESHOLDS))]


def write_results(units: Sequence[Unit], store: Store, path: Path) -> Path:
    """Summarise finished units to a JSON file; FileNotFoundError where one is not finished."""
    cells: dict[str, list[dict]] = {}
    seconds, commits = 0.0, set()
    for unit in units:
        result = store.read(unit.key)
        cells.setdefault(unit.cell.key, []).extend(result["trials"])
        seconds += result["seconds"]
        commits.add(result["commit"])
    summaries = {key: summarise(trials) for key, trials in cells.items()}
    sweeps = {
        name: [{"level": level, "cell": cell.key} for level, cell in levels.items() if cell.key in summaries]
        for name, levels in SWEEPS.items()
    }
    document = {"commits": sorted(commits), "cpu_minutes": round(seconds / 60, 1), "thresholds": THRESHOLDS,
                "sweeps": sweeps, "cells": summaries}  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    path.write_text(text.replace('},"', '},\n"') + "\n", encoding="utf-8")
    return path


def summarise(trials: Sequence[dict]) -> dict[str, Any]:
    """Results of one cell: by method, by measure, a value and its interval."""
    table = _table(trials, "qualitative")
    methods = {
        "ours": _measures(_table(trials, "ours")),
        "unconstrained": _measures(_table(trials, "unconstrained")),
        "true_spans": _properties(_table(trials, "true_spans")["property"]),
        "rigid": _properties(_table(trials, "true_spans")["rigid"]),
        "qualitative": [_measures(_at(table, pair, i)) for i, pair in enumerate(DIAGONAL)],
        "hindsight": _hindsight(table),
    }
    return {"trials": len(trials), "methods": methods, "sampled": _sampled(trials)}


def _table(trials: Sequence[dict], method: str) -> dict[str, np.ndarray]:
    """Arrays (num_trials, ...) of everything a method has, NaN for null."""
    keys = [key for key in trials[0][method] if key != "sampled"]
    return {key: np.array([trial[method][key] for trial in trials], dtype=float) for key in keys}


def _at(table: dict[str, np.ndarray], pair: int, diagonal: int) -> dict[str, np.ndarray]:
    """The baseline's table at one pair of thresholds."""
    return {key: values[:, diagonal if key == "property" else pair] for key, values in table.items()}


def _measures(table: dict[str, np.ndarray]) -> dict[str, Any]:
    size = _missing_as_infinite(table["residual"])
    out = {
        "boundary_median": _interval(size, lambda a: _quantile(a, 0.5)),
        "boundary_95": _interval(size, lambda a: _quantile(a, 0.95)),
        "boundaries_found": _interval(np.isfinite(size).astype(float), _mean),
        "complete": _interval(np.isfinite(size).all(axis=1).astype(float), _mean),
        "accuracy": _interval(table["accuracy"], _mean),
        **_properties(table["property"]),
    }
    if "sample_accuracy" in table:
        out["sample_accuracy"] = _interval(table["sample_accuracy"], _mean)
    if "inside_90" in table:
        out["coverage_90"] = _interval(table["inside_90"], _mean)
    if "inside_95" in table:
        inside = _by_property(table["inside_95"])
        out["coverage_95"] = _interval(table["inside_95"], _mean)
        out |= {f"coverage_95_{name}": _interval(values, _mean) for name, values in inside.items()}
    return out


def _properties(residual: np.ndarray) -> dict[str, Any]:
    return {
        name: _interval(_missing_as_infinite(values), lambda a: _quantile(a, 0.5))
        for name, values in _by_property(residual).items()
    }


def _by_property(values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns (num_trials, num_objects) of each property."""
    return {name: values[:, i :: len(PROPERTIES)] for i, name in enumerate(PROPERTIES)}


def _hindsight(table: dict[str, np.ndarray]) -> dict[str, Any]:
    """The baseline with the pair of thresholds that, the truth known, does best: for each measure its own."""
    pairs = range(table["residual"].shape[1])
    scored = [_quick(_at(table, pair, 0)) for pair in pairs]
    out = {}
    for key in ("boundary_median", "boundary_95", "accuracy"):
        best = min(pairs, key=lambda pair: scored[pair][key])
        force, velocity = divmod(best, len(THRESHOLDS))
        out[key] = _measures(_at(table, best, 0))[key] | {
            "thresholds": [THRESHOLDS[force], THRESHOLDS[velocity]]
        }
    alike = [_properties(table["property"][:, i]) for i in range(len(THRESHOLDS))]
    for name in PROPERTIES:
        best = min(range(len(alike)), key=lambda i: _or_infinite(alike[i][name]["value"]))
        out[name] = alike[best][name] | {"thresholds": [THRESHOLDS[best]] * 2}
    return out


def _quick(table: dict[str, np.ndarray]) -> dict[str, float]:
    """What a pair of thresholds is chosen by, smaller is better."""
    size = _missing_as_infinite(table["residual"])
    return {"boundary_median": float(_quantile(size[None], 0.5)[0]),
            "boundary_95": float(_quantile(size[None], 0.95)[0]),
            "accuracy": -float(np.mean(table["accuracy"]))}  # fmt: skip


def _sampled(trials: Sequence[dict]) -> dict[str, Any]:
    """The sampled posterior against the Laplace one, over the trials for which both were made."""
    runs = [trial["ours"]["sampled"] for trial in trials if "sampled" in trial["ours"]]
    pooled = {key: np.concatenate([run[key] for run in runs]) for key in
              ("inside_95", "laplace_inside_95", "shift", "width_ratio")} if runs else {}  # fmt: skip
    return {
        "trials": len(runs),
        "coverage_95": _or_null(np.mean(pooled["inside_95"])) if runs else None,
        "laplace_coverage_95": _or_null(np.mean(pooled["laplace_inside_95"])) if runs else None,
        "properties": int(pooled["shift"].size) if runs else 0,
        "shift_rms": _or_null(np.sqrt(np.mean(pooled["shift"] ** 2))) if runs else None,
        "width_ratio": [_or_null(q) for q in np.quantile(pooled["width_ratio"], QUANTILES)] if runs else None,
        "converged": sum(run["ess"] >= 1000 and run["rhat"] <= 1.01 for run in runs),
    }  # fmt: skip


def _interval(values: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """A statistic of values (num_trials, ...) and its 95 % bootstrap interval over trials."""
    rng = np.random.default_rng(0)
    drawn = values[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    low, high = _quantile(statistic(drawn)[None], 0.025)[0], _quantile(statistic(drawn)[None], 0.975)[0]
    return {"value": _or_null(statistic(values[None])[0]), "interval_95": [_or_null(low), _or_null(high)]}


def _quantile(values: np.ndarray, q: float) -> np.ndarray:
    """Quantile over all axes but the first, by the nearest value above: infinities stay so."""
    return np.quantile(values.reshape(len(values), -1), q, axis=1, method="higher")


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over all axes but the first of what is known."""
    flat = values.reshape(len(values), -1)
    known = np.isfinite(flat)
    count = known.sum(axis=1)
    return np.where(count > 0, np.where(known, flat, 0.0).sum(axis=1) / np.maximum(count, 1), np.inf)


def _missing_as_infinite(residual: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(residual), np.abs(residual), np.inf)


def _or_null(value: Any) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value
