"""What counts as right: the true verdict of a case, its cells, its parameters, effects that share a set."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.blind_check.effects import CATALOGUE

FLOOR = 5.0  # nats of held-out log-likelihood
AFFECTED = 3.0  # standard deviations of a sample
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


def affected_cells(entry: dict[str, Any]) -> set[tuple[str, str]]:
    """Cells (channel, subtask) whose mean shift, over the trials, is at least AFFECTED sd of a sample."""
    out = set()
    for channel in entry["shift"][0]:
        rows = np.array([trial[channel] for trial in entry["shift"]])  # (trials, subtasks)
        size = np.sqrt((rows**2).mean(0))
        out |= {(channel, s) for s, z in zip(entry["subtasks"], size, strict=True) if z >= AFFECTED}
    return out


def true_parameters(entry: dict[str, Any]) -> dict[str, float]:
    """True values by the names that a diagnosis uses: prefixed by the effect where there are two."""
    out = {}
    for name, values in entry["effects"].items():
        if not CATALOGUE[name].scored:
            continue
        prefix = "" if len(entry["effects"]) == 1 else f"{name}."
        for key, value in values.items():
            if name == "structural_vibration" and key == "frequency":
                rate = entry["world"]["rate"]
                value = abs(value - rate * round(value / rate))  # known modulo aliases
            out[prefix + key] = value
    return out
