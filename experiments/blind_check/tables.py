"""The check's figures as Markdown for people and for docs/."""

from __future__ import annotations

from typing import Any

from experiments.table_text import load, percent

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
    "seconds": ("CPU seconds a case, median", ""),
}


def number(entry: dict[str, Any]) -> str:
    """A figure with its 95 % interval."""
    if entry["value"] is None:
        return "none to judge"
    low, high = entry["interval_95"]
    return f"{entry['value']:.3g} ({low:.2g} to {high:.2g})"


def goals(found: dict[str, Any]) -> str:
    """Figures and their goals."""
    lines = ["| figure | goal | found (95 % interval) | cases |", "|---|---|---|---|"]
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


def everything(found: dict[str, Any]) -> str:
    """All figures, for the terminal and docs/tables/blind.csv."""
    seal = found["seal"]
    cases = ", ".join(f"{n} {t}" for t, n in found["cases"].items())
    sizes = ["| size of the effect | named |", "|---|---|"]
    sizes += [f"| {row['from']:g} to {row['to']:g} | {_counted(row['named'])} |" for row in found["by_size"]]
    effects = ["| effect | named, above the floor |", "|---|---|"]
    effects += [f"| {name} | {_counted(entry)} |" for name, entry in found["by_effect"].items()]
    head = f"Sealed set {seal['sha256'][:12]} ({seal['status']}): {cases}."
    return "\n\n".join([head, goals(found), brackets(found), "\n".join(sizes), "\n".join(effects)])


def fresh() -> dict[str, Any] | None:
    """The last blind check, or None if its set has been spent."""
    found, spent = load("blind_check"), load("blind_sets")
    if found is None or found["seal"]["sha256"] in {one["seal"] for one in (spent or {"sets": []})["sets"]}:
        return None
    return found


def blind() -> str | None:
    """docs/gap_results.md: the figures of the blind check."""
    found = fresh()
    return None if found is None else goals(found)


def by_circumstance() -> str | None:
    """docs/tables/blind.csv: the same by circumstance, size and effect."""
    found = fresh()
    return None if found is None else everything(found)


def describe() -> str:
    """docs/results.md: the blind check in a few sentences; "" if its set is spent."""
    found = fresh()
    if found is None:
        return ""
    t = found["table"]

    def share(name: str) -> str:
        if t[name]["value"] is None:
            return "none to judge"
        low, high = t[name]["interval_95"]
        return f"{percent(t[name]['value'], 0)} ({100 * low:.0f} to {100 * high:.0f})"

    false = t["false_alarms"]
    return (
        f"\n\nBlind, on {sum(found['cases'].values())} sealed cases of another simulator (MuJoCo), each in a "
        f"world of its own (rate, pace, pads, sensors, operator, task): right names above the detection "
        f"floor {share('named_right')}, false alarms on healthy recordings {false['hits']} of "
        f"{false['count']}, effects from outside the catalogue recognised {share('outside_right')}, pairs "
        f"{share('pair_both')} (goals: 95, 1, 90 and 85 %). All figures, and what they show, stand in "
        "[gap_results.md](gap_results.md)."
    )
