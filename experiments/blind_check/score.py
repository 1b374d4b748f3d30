"""The separate scorer: opens the seal, checks the hash, compares, writes every figure of the contract."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from experiments.blind_check.sealing import unseal
from experiments.blind_check.truth import (
    FLOOR,
    affected_cells,
    label,
    partners,
    true_parameters,
)

SIZES = (0.0, 0.1, 0.3, 1.0)
GAINS = (5.0, 20.0, 100.0, float("inf"))
BINS = 10
RIVALS = ("bic", "all_at_once", "cosine")
SPREADS = ("clock_jitter", "quantisation")  # their held-out score is no gain: see rivals.py
# A diagnosis that ended in an error.
NOTHING: dict[str, Any] = {
    "verdict": "error",
    "causes": [],
    "indistinguishable": [],
    "probabilities": {},
    "where": [],
    "effects": {},
    "shrinkage": None,
    "rivals": {},
    "gains": {},
}
Oracle = Callable[[str, str], dict[str, float | None]]  # case, effects -> gain, fraction


def score(
    folder: Path,
    results: Path,
    oracle: Oracle | None = None,
    follow: Callable[[Path, Path], list[dict[str, Any]]] | None = None,
    first: int | None = None,
) -> dict[str, Any]:
    """All figures of a sealed set. BrokenSeal where labels changed, ValueError where results lack.

    `oracle` fits true effects by force, `follow` carries out the experiments that were asked for. `first`
    judges only so many cases, for a run that its time cut short: their order tells nothing.
    """
    labels = unseal(folder)
    rows = []
    for entry in labels["cases"][:first]:
        file = results / f"{entry['case']}.json"
        if not file.exists():
            raise ValueError(f"{file}: no result; run diagnose to the end first")
        found = json.loads(file.read_text(encoding="utf-8"))
        rows.append(judge_case(entry, found, oracle))
    code = json.loads((results / "code.json").read_text(encoding="utf-8"))["sha256"]
    seal = json.loads((folder / "seal.json").read_text(encoding="utf-8"))
    followed = follow(folder, results) if follow is not None else []
    out = {"seal": seal, "code": code, **figures(rows), "followed": followed}
    out["table"]["next_separates"] = proportion([f["separated"] for f in followed if f["do"]])
    out["table"]["next_asked"] = proportion([f["do"] is not None for f in followed])
    return out


def judge_case(entry: dict[str, Any], found: dict[str, Any], oracle: Oracle | None = None) -> dict[str, Any]:
    """One case: what is true, what was said, and whether that is right."""
    failed = "error" in found
    if failed:
        found = {**NOTHING, "seconds": found["seconds"]}
    true, said = sorted(entry["effects"]), sorted(found["causes"])
    together = set(said) | set(found["indistinguishable"])
    best = {"gain": None, "fraction": None}
    if true and entry["tier"] != "outside":
        best = _true_fit(entry, found, oracle if not failed else None)
    gain = best["gain"]
    row: dict[str, Any] = {
        "case": entry["case"],
        "tier": entry["tier"],
        "true": true,
        "sizes": entry["sizes"],
        "measured": entry["measured"],
        "verdict": found["verdict"],
        "said": said,
        "partners": sorted(found["indistinguishable"]),
        "gain": gain,
        # What makes a recording be refused is not too small to see: a refusal counts, and is wrong.
        "above": failed or (gain is not None and gain >= FLOOR and seen_each(entry, found)),
        "right": said == true and found["verdict"] in ("none", "named", "set"),
        "right_set": set(true) <= together and len(said) == max(len(true), 1),
        "probability": found["probabilities"].get(label(entry), 0.0),
        "rivals": found["rivals"],
        "seconds": found["seconds"],
    }
    if entry["tier"] == "outside":
        row["right"] = row["right_set"] = found["verdict"] == "unknown"
    if entry["tier"] == "withheld":
        shared = bool(together & stand_ins(entry, found)) and len(said) == 1
        row["right"] = row["right_set"] = found["verdict"] == "unknown" or shared
    row["top"] = _top(entry, found)
    if row["right"] and true and entry["tier"] in ("single", "pair"):
        row["covered"] = _covered(entry, found)
    if true:
        row["cells"] = _cells(entry, found)
    row["shrinkage"] = _shrunk(found, best["fraction"])
    return row


def seen_each(entry: dict[str, Any], found: dict[str, Any]) -> bool:
    """Whether each effect of a pair lies above the floor by itself, where the scorer knows that."""
    return entry["tier"] != "pair" or all(found["gains"].get(n, FLOOR) >= FLOOR for n in entry["effects"])


def stand_ins(entry: dict[str, Any], found: dict[str, Any]) -> set[str]:
    """Effects that may stand for a withheld one: its partners, and what predicts held-out trials as well."""
    gains, (name,) = found["gains"], entry["effects"]
    own = gains.get(name, np.inf)
    return partners(entry) | {k for k, v in gains.items() if k != name and v >= own - FLOOR}


def _true_fit(entry: dict, found: dict, oracle: Oracle | None) -> dict[str, float | None]:
    """Held-out gain [nats] and shrinkage of the true effects: the diagnosis's own fit, else by force."""
    name = "+".join(sorted(entry["effects"]))
    listed = found["effects"].get(name)
    right = sorted(found["causes"]) == sorted(entry["effects"]) and found["shrinkage"]
    gain = found["gains"].get(name) if name in SPREADS or not listed else listed["heldout_score"]
    fraction = found["shrinkage"]["fraction"] if right else None
    if (gain is None or (fraction is None and gain >= FLOOR)) and oracle is not None:
        forced = oracle(entry["case"], name)
        gain = gain if gain is not None else forced["gain"]
        fraction = fraction if fraction is not None else forced["fraction"]
    return {"gain": gain, "fraction": fraction}


def _shrunk(found: dict, oracle: float | None) -> float | None:
    """Shrinkage over that of the true effect; 0 where nothing was named."""
    if oracle is None or oracle <= 0.05:  # the true effect itself shrinks nothing to speak of
        return None
    own = found["shrinkage"]["fraction"] if found["shrinkage"] else 0.0
    return None if own is None else float(own / oracle)


def _top(entry: dict, found: dict) -> tuple[float, bool] | None:
    """Largest probability and whether it lies on what is true."""
    known = {k: v for k, v in found["probabilities"].items() if k != "other"}
    if not known:
        return None
    name = max(known, key=lambda k: known[k])
    right = name == label(entry)
    if entry["tier"] == "withheld":
        right = right or name in stand_ins(entry, found)
    return float(known[name]), right


def _covered(entry: dict, found: dict) -> dict[str, bool]:
    """Whether the 90 % interval of each parameter holds the true value."""
    true = true_parameters(entry)
    got = found["effects"]["+".join(sorted(found["causes"]))]["parameters"]
    return {
        k: bool(got[k]["interval_90"][0] <= v <= got[k]["interval_90"][1])
        for k, v in true.items()
        if k in got
    }


def _cells(entry: dict, found: dict) -> dict[str, Any]:
    """Hits, false and missed cells, and the channels of those missed."""
    truly = affected_cells(entry)
    said = {(w["channel"], w["subtask"]) for w in found["where"]}
    missed = sorted(f"{channel} {subtask}" for channel, subtask in truly - said)
    return {"hit": len(truly & said), "false": len(said - truly), "missed": len(missed), "which": missed}


def proportion(flags: list[bool]) -> dict[str, Any]:
    """A proportion with its exact binomial 95 % interval (Clopper & Pearson, Biometrika 26, 1934)."""
    n, k = len(flags), int(sum(flags))
    if n == 0:
        return {"count": 0, "value": None, "interval_95": None}
    ends = binomtest(k, n).proportion_ci(0.95, "exact")
    return {"count": n, "hits": k, "value": k / n, "interval_95": [float(ends.low), float(ends.high)]}


def mean(values: list[float], seed: int = 0, statistic: Callable = np.mean) -> dict[str, Any]:
    """A mean (or another statistic) over cases with its bootstrap 95 % interval."""
    if not values:
        return {"count": 0, "value": None, "interval_95": None}
    x, rng = np.array(values), np.random.default_rng(seed)
    draws = [statistic(x[rng.integers(0, x.size, x.size)]) for _ in range(1000)]
    low, high = np.percentile(draws, (2.5, 97.5))
    return {"count": x.size, "value": float(statistic(x)), "interval_95": [float(low), float(high)]}


def clustered(groups: list[list[bool]], seed: int = 0) -> dict[str, Any]:
    """A proportion of flags that come in clusters (cases), with its bootstrap 95 % interval over clusters."""
    groups = [g for g in groups if g]
    if not groups:
        return {"count": 0, "value": None, "interval_95": None}
    hits, sizes = np.array([sum(g) for g in groups]), np.array([len(g) for g in groups])
    rng = np.random.default_rng(seed)
    pick = rng.integers(0, len(groups), (2000, len(groups)))
    low, high = np.percentile(hits[pick].sum(1) / sizes[pick].sum(1), (2.5, 97.5))
    value = float(hits.sum() / sizes.sum())
    return {"count": int(sizes.sum()), "cases": len(groups), "value": value, "interval_95": [low, high]}


def figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The table of the contract, by tier and size, and what the figures are drawn from."""
    tier = {t: [r for r in rows if r["tier"] == t] for t in dict.fromkeys(r["tier"] for r in rows)}
    single = [r for r in tier.get("single", []) if r["above"]]
    pairs = [r for r in tier.get("pair", []) if r["above"]]
    healthy, outside = tier.get("healthy", []), tier.get("outside", [])
    seen = [*healthy, *single, *pairs, *outside, *[r for r in tier.get("withheld", []) if r["above"]]]
    ratios = [r["shrinkage"] for r in (*single, *pairs) if r["shrinkage"] is not None]
    table = {
        "false_alarms": proportion([r["verdict"] != "none" for r in healthy]),
        "named_right": proportion([r["right"] for r in single]),
        "set_right": proportion([r["right_set"] for r in single]),
        "probability_of_true": mean([r["probability"] for r in single]),
        "calibration_error": calibration(seen)["error"],
        "coverage_90": clustered([list(r["covered"].values()) for r in rows if "covered" in r]),
        "outside_unknown": proportion([r["right"] for r in outside]),
        "known_rejected": proportion([r["verdict"] == "unknown" for r in single]),
        "withheld_right": proportion([r["right"] for r in tier.get("withheld", []) if r["above"]]),
        "pair_exact": proportion([r["right"] for r in pairs]),
        "location_f1": location(single),
        "shrinkage_over_oracle": mean(ratios, statistic=np.median),
        "too_small_none": proportion(
            [r["verdict"] == "none" for r in tier.get("single", []) if not r["above"]]
        ),
        "seconds": mean([r["seconds"] for r in rows], statistic=np.median),
    }
    return {
        "cases": {t: len(r) for t, r in tier.items()},
        "above_floor": {"single": len(single), "pair": len(pairs)},
        "table": table,
        "by_effect": {
            e: {
                "named": proportion([r["right"] for r in single if r["true"] == [e]]),
                "set": proportion([r["right_set"] for r in single if r["true"] == [e]]),
            }
            for e in sorted({r["true"][0] for r in tier.get("single", [])})
        },
        "by_size": _by(tier.get("single", []), lambda r: max(r["sizes"].values()), SIZES),
        "by_gain": _by([r for r in single if r["gain"] is not None], lambda r: r["gain"], GAINS),
        "rivals": {k: _rival(k, healthy, single, outside) for k in RIVALS},
        "confusion": confusion([*healthy, *single, *pairs, *outside]),
        "reliability": calibration(seen)["bins"],
        "rows": rows,
    }


def _by(rows: list[dict], value: Callable, edges: tuple[float, ...]) -> list[dict]:
    out = []
    for low, high in pairwise(edges):
        mine = [r for r in rows if low <= value(r) < high or (value(r) == high == edges[-1])]
        entry: dict[str, Any] = {
            "from": low,
            "to": None if np.isinf(high) else high,
            "above": sum(r["above"] for r in mine),
        }
        entry |= {"named": proportion([r["right"] for r in mine])}
        entry |= {"set": proportion([r["right_set"] for r in mine])}
        entry |= {k: proportion([r["rivals"].get(k) == r["true"][0] for r in mine]) for k in RIVALS}
        out.append(entry)
    return out


def _rival(name: str, healthy: list, single: list, outside: list) -> dict[str, Any]:
    return {
        "false_alarms": proportion([r["rivals"].get(name) != "none" for r in healthy]),
        "named_right": proportion([r["rivals"].get(name) == r["true"][0] for r in single]),
        "outside_named": proportion([r["rivals"].get(name) != "none" for r in outside]),
    }


def location(rows: list[dict]) -> dict[str, Any]:
    """F1 over all cells of the cases, with a bootstrap 95 % interval over cases."""
    counts = np.array([[r["cells"][k] for k in ("hit", "false", "missed")] for r in rows if "cells" in r])
    if not counts.size or counts.sum() == 0:
        return {"count": 0, "value": None, "interval_95": None}

    def f1(c: np.ndarray) -> float:
        hit, false, missed = c.sum(0)
        return float(2 * hit / max(2 * hit + false + missed, 1))

    rng = np.random.default_rng(0)
    draws = [f1(counts[rng.integers(0, len(counts), len(counts))]) for _ in range(1000)]
    hit, false, missed = (int(v) for v in counts.sum(0))
    return {
        "count": len(counts), "value": f1(counts), "interval_95": list(np.percentile(draws, (2.5, 97.5))),
        "precision": hit / max(hit + false, 1), "recall": hit / max(hit + missed, 1),
    }  # fmt: skip


def calibration(rows: list[dict]) -> dict[str, Any]:
    """Expected calibration error of the largest probability (BINS of equal width), and its bins."""
    pairs = [r["top"] for r in rows if r["top"] is not None]
    if not pairs:
        return {"error": {"count": 0, "value": None, "interval_95": None}, "bins": []}
    p, right = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs], float)
    place = np.minimum((p * BINS).astype(int), BINS - 1)

    def error(rows_of: np.ndarray) -> float:
        gap = [abs((right[k] - p[k]).sum()) for b in range(BINS) for k in [rows_of[place[rows_of] == b]]]
        return float(sum(gap) / rows_of.size)

    rng = np.random.default_rng(0)
    draws = [error(rng.integers(0, p.size, p.size)) for _ in range(1000)]
    bins = []
    for b in range(BINS):
        mine = place == b
        if mine.any():
            flags = [bool(v) for v in right[mine]]
            bins.append({"said": float(p[mine].mean()), "right": proportion(flags)})
    value = {"count": int(p.size), "value": error(np.arange(p.size)),
             "interval_95": list(np.percentile(draws, (2.5, 97.5)))}  # fmt: skip
    return {"error": value, "bins": bins}


def confusion(rows: list[dict]) -> dict[str, dict[str, int]]:
    """Counts by what is true and what was said: an effect, none, unknown, a pair, an error."""
    out: dict[str, dict[str, int]] = {}
    for r in rows:
        true = {"healthy": "none", "outside": "unknown", "pair": "pair"}.get(r["tier"]) or r["true"][0]
        said = r["verdict"] if r["verdict"] in ("none", "unknown", "error") else r["said"][0]
        if len(r["said"]) > 1:
            said = "pair"
            if r["tier"] == "pair" and not r["right"]:
                said = "wrong pair"
        out.setdefault(true, {}).setdefault(said, 0)
        out[true][said] += 1
    return out
