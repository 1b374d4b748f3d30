"""The check's figures as Markdown for people and for docs/."""

from __future__ import annotations

from typing import Any

# Figure: words, and what is to be reached.
FIGURES = {
    "false_alarms": ("false alarms on healthy recordings, default flags", "<= 0.01"),
    "slight_none": ("healthy with errors below the rig's tolerance: none", ""),
    "named_right": ("named right, above the floor", ">= 0.95"),
    "set_right": ("right set, above the floor", ">= 0.98"),
    "probability_of_true": ("mean probability of the true cause", ">= 0.90"),
    "calibration_error": ("calibration error over all cases", "<= 0.03"),
    "outside_right": ("outside, first seen: unknown, or a remainder above 30 %", ">= 0.90"),
    "withheld_right": ("effect taken out: the same, or its partners", ">= 0.90"),
    "pair_both": ("pairs, both named", ">= 0.85"),
    "dense_dominant": ("dense: dominant effect named", ">= 0.90"),
    "inclusion_dense": ("dense: calibration error of inclusion probabilities", "<= 0.05"),
    "inclusion_all": ("the same over all tiers but outside", "<= 0.05"),
    "coverage_dense": ("dense: 90 % intervals of parameters cover", "0.87-0.93"),
    "coverage_90": ("90 % intervals of named effects' parameters cover", "0.87-0.93"),
    "location_f1": ("where: F1 over all verdicts", "> 0.80"),
    "known_rejected": ("known effects called unknown", "<= 0.05"),
    "small_none": ("effects below the floor called none", ""),
    "bic_named": ("BIC over single effects: named right", ""),
    "bic_alarms": ("BIC over single effects: false alarms", ""),
    "errors": ("ended in an error", "0"),
    "seconds": ("CPU seconds a case, healthy twins included, median", ""),
}


def number(entry: dict[str, Any]) -> str:
    """A figure with its 95 % interval."""
    if entry["value"] is None:
        return "none to judge"
    low, high = entry["interval_95"]
    return f"{entry['value']:.3g} ({low:.2g} to {high:.2g})"


def goals(found: dict[str, Any]) -> str:
    """Figures beside what they are to reach."""
    lines = ["| figure | to reach | found (95 % interval) | cases |", "|---|---|---|---|"]
    for key, (words, goal) in FIGURES.items():
        entry = found["table"].get(key)
        if entry is not None:
            lines.append(f"| {words} | {goal} | {number(entry)} | {entry.get('cases', entry['count'])} |")
    return "\n".join(lines)


def brackets(found: dict[str, Any]) -> str:
    """The figures that no single world may fail, by bracket of every circumstance."""
    lines = [
        "| circumstance | bracket | false alarms | named right | outside right |",
        "|---|---|---|---|---|",
    ]
    for name, entries in found["brackets"].items():
        for bracket, figures in entries.items():
            lines.append(f"| {name} | {bracket} | {' | '.join(_counted(f) for f in figures.values())} |")
    return "\n".join(lines)


def _counted(entry: dict[str, Any]) -> str:
    return "" if entry["value"] is None else f"{entry['hits']} of {entry['count']}"


def table(found: dict[str, Any]) -> str:
    """Everything, for the terminal."""
    seal = found["seal"]
    cases = ", ".join(f"{n} {t}" for t, n in found["cases"].items())
    sizes = ["| size of the effect | named |", "|---|---|"]
    sizes += [f"| {row['from']:g} to {row['to']:g} | {_counted(row['named'])} |" for row in found["by_size"]]
    effects = ["| effect | named, above the floor |", "|---|---|"]
    effects += [f"| {name} | {_counted(entry)} |" for name, entry in found["by_effect"].items()]
    head = f"Sealed set {seal['sha256'][:12]} ({seal['status']}): {cases}."
    return "\n\n".join([head, goals(found), brackets(found), "\n".join(sizes), "\n".join(effects)])
