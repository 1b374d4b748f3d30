"""Judge a case: its truth, its diagnosis, and whether that is right."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.blind_check.effects import CATALOGUE

FLOOR = 5.0  # nats that an effect gains, its parameters paid for
AFFECTED = 3.0  # standard deviations of a sample
VISIBLE = 1.0  # the same, rms over a cell, of an effect that is not fitted
# Effects indistinguishable from a withheld one in these recordings (* only without actual.toml).
PARTNERS = {
    "force_gain": ("fingertip_compliance*",),
    "fingertip_compliance": ("force_gain*",),
    "fingertip_mass": ("force_bias",),
}
HEALTHY = ("healthy", "slight")
HONEST = 0.3  # remainder beyond which a named cause does not hide an effect from outside
# A diagnosis that ended in an error.
NOTHING: dict[str, Any] = {
    "verdict": "error", "causes": [], "indistinguishable": [], "probabilities": {}, "attribution": {},
    "where": [], "effects": {}, "shrinkage": None, "remainder": None, "bic": "error", "gains": {},
}  # fmt: skip


def label(entry: dict[str, Any]) -> str:
    """Name of the probability that should be largest."""
    if entry["tier"] in ("healthy", "slight"):
        return "none"
    if entry["tier"] in ("outside", "withheld"):
        return "unknown"
    return "+".join(sorted(entry["effects"]))


def partners(entry: dict[str, Any]) -> set[str]:
    """Effects of the catalogue whose set with the withheld one is a right answer; none for several
    effects."""
    given = (
        [p for name in entry["effects"] for p in PARTNERS.get(name, ())] if len(entry["effects"]) == 1 else []
    )
    return {p.rstrip("*") for p in given if not (p.endswith("*") and entry["measured"])}


def _sizes(entry: dict[str, Any], which: str) -> dict[str, np.ndarray]:
    """Root mean square over trials (subtasks,) of a label's `shift` or `spread`, by channel."""
    return {
        channel: np.sqrt(np.mean([np.square(trial[channel]) for trial in entry[which]], axis=0))
        for channel in entry[which][0]
    }


def affected_cells(entry: dict[str, Any]) -> set[tuple[str, str]]:
    """Cells (channel, subtask) whose mean shift, over the trials, is at least AFFECTED sd of a sample."""
    return {
        (channel, subtask)
        for channel, size in _sizes(entry, "shift").items()
        for subtask, z in zip(entry["subtasks"], size, strict=True)
        if z >= AFFECTED
    }


def visible(entry: dict[str, Any]) -> bool:
    """Whether the effects move any cell by VISIBLE standard deviations of a sample."""
    return max(float(size.max()) for size in _sizes(entry, "spread").values()) >= VISIBLE


def true_parameters(entry: dict[str, Any]) -> dict[str, float]:
    """True values by effect and parameter, of effects whose parameters mean what the contract's mean."""
    out = {}
    for name, values in entry["effects"].items():
        if name not in CATALOGUE or not CATALOGUE[name].scored:
            continue
        for key, value in values.items():
            if name == "structural_vibration" and key == "frequency":
                rate = entry["world"]["rate"]
                value = abs(value - rate * round(value / rate))  # known modulo aliases
            out[f"{name}.{key}"] = value
    return out


def judge_case(entry: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """The results' row for a case; tables are made from rows only."""
    failed = "error" in found
    if failed:
        found = {**NOTHING, "seconds": found["seconds"], "error": found["error"]}
    true, said, tier = sorted(entry["effects"]), sorted(found["causes"]), entry["tier"]
    together = {*said, *found["indistinguishable"]}
    rest = (found.get("remainder") or {}).get("share")
    named = found["verdict"] in ("named", "set")
    row: dict[str, Any] = {
        "case": entry["case"],
        "tier": tier,
        "brackets": entry["brackets"],
        "true": true,
        "sizes": entry["sizes"],
        "verdict": found["verdict"],
        "said": said,
        "partners": sorted(found["indistinguishable"]),
        "remainder": rest,
        "gain": _gain(entry, found),
        "above": failed or _above(entry, found),
        "right": found["verdict"] == "none" if tier in HEALTHY else named and said == true,
        "right_set": set(true) <= together and len(said) == max(len(true), 1),
        "probability": found["probabilities"].get(label(entry), 0.0),
        "bic": found["bic"],
        "seconds": found["seconds"],
        "cells": _cells(entry, found),
        "top": _top(entry, found),
        "inclusion": _inclusion(entry, found),
    }
    if failed:
        row["error"] = found["error"]
    if tier == "outside":
        row["right"] = found["verdict"] == "unknown" or (rest is not None and rest > HONEST)
    if tier == "withheld":
        shared = bool(together & partners(entry)) and len(said) == 1
        row["right"] = found["verdict"] == "unknown" or shared or (rest is not None and rest > HONEST)
    if tier == "dense":
        row["dominant"] = bool(true) and max(entry["sizes"], key=lambda k: entry["sizes"][k]) in said
    if tier in ("single", "pair", "dense") and named:
        row["covered"] = intervals_hold(entry, found)
    return row


def _gain(entry: dict, found: dict) -> float | None:
    """Smallest gain [nats] of the true effects, each alone; None if one was not fitted."""
    known = [found["gains"].get(n) for n in entry["effects"]]
    return None if not known or None in known else float(min(known))  # type: ignore[type-var]


def _above(entry: dict, found: dict) -> bool:
    """Whether each true effect is detectable: by its gain if fitted, else by its shift."""
    gain = _gain(entry, found)
    return visible(entry) if gain is None else gain >= FLOOR


def _top(entry: dict, found: dict) -> tuple[float, bool] | None:
    """The largest probability, and whether it belongs to the truth."""
    known = {k: v for k, v in found["probabilities"].items() if k != "other"}
    if not known:
        return None
    name = max(known, key=lambda k: known[k])
    right = name == label(entry)
    if entry["tier"] == "withheld":
        right = right or name in partners(entry)
    return float(known[name]), right


def _inclusion(entry: dict, found: dict) -> list[tuple[float, bool]]:
    """Probability that each effect acts, and whether it does; empty for outside cases."""
    if entry["tier"] in ("outside", "withheld"):
        return []
    acting = found.get("attribution") or {}
    return [(float(a["probability"]), name in entry["effects"]) for name, a in acting.items()]


def intervals_hold(entry: dict, found: dict) -> dict[str, bool]:
    """Whether the 90 % interval of each parameter of the named true effects contains its value."""
    got = {}
    for name in found["causes"]:
        for key in (name, "+".join(sorted(found["causes"]))):
            for k, p in found["effects"].get(key, {}).get("parameters", {}).items():
                got[k if k.startswith(f"{name}.") else f"{name}.{k}"] = p["interval_90"]
    return {
        k: bool(got[k][0] <= v <= got[k][1])
        for k, v in true_parameters(entry).items()
        if k in got and None not in got[k]
    }


def _cells(entry: dict, found: dict) -> dict[str, Any]:
    """Hits, false and missed cells."""
    truly = affected_cells(entry)
    where = (found.get("small_gap") or {}).get("where") or found["where"]
    said = {(w["channel"], w["subtask"]) for w in where}
    return {"hit": len(truly & said), "false": len(said - truly), "missed": len(truly - said)}
