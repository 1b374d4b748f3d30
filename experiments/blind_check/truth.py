"""What counts as right: the true verdict of a case, its cells, its parameters, effects that share a set."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.blind_check.effects import CATALOGUE

FLOOR = 5.0  # nats that an effect gains, its parameters paid for
AFFECTED = 3.0  # standard deviations of a sample
VISIBLE = 1.0  # the same, rms over a cell, of an effect that is not fitted
# What these recordings cannot tell from a withheld effect (gap-effects.md; * only without actual.toml).
PARTNERS = {
    "force_gain": ("fingertip_compliance*",),
    "fingertip_compliance": ("force_gain*",),
    "fingertip_mass": ("force_bias",),
}


def label(entry: dict[str, Any]) -> str:
    """The probability's name that ought to be large."""
    if entry["tier"] in ("healthy", "slight"):
        return "none"
    if entry["tier"] in ("outside", "withheld"):
        return "unknown"
    return "+".join(sorted(entry["effects"]))


def partners(entry: dict[str, Any]) -> set[str]:
    """Effects of the catalogue whose set with the withheld one is a right answer."""
    (name,) = entry["effects"]
    given = PARTNERS.get(name, ())
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
