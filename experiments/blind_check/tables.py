"""The check's figures as a Markdown table for people and for docs/."""

from __future__ import annotations

from typing import Any

# Figure: words, what is to be reached, and whether that bounds it from above.
FIGURES = {
    "false_alarms": ("false alarms on healthy recordings", "<= 0.01"),
    "named_right": ("named effect right, above the floor", ">= 0.95"),
    "set_right": ("right set, above the floor", ">= 0.98"),
    "probability_of_true": ("mean probability of the true cause", ">= 0.90"),
    "calibration_error": ("calibration error", "<= 0.05"),
    "coverage_90": ("90 % intervals of parameters cover", "0.87-0.93"),
    "outside_unknown": ("outside the catalogue -> unknown", ">= 0.90"),
    "known_rejected": ("known effects called unknown", "<= 0.05"),
    "withheld_right": ("effect taken out -> unknown or its partners", ">= 0.90"),
    "pair_exact": ("two effects, exact pair", ">= 0.80"),
    "location_f1": ("location: F1 over channel x subtask", "> 0.85"),
    "shrinkage_over_oracle": ("median shrinkage over the oracle's", ">= 0.95"),
    "next_separates": ("next experiment, carried out, separates the set", ">= 0.80"),
    "next_asked": ("sets that an experiment was named for", ""),
    "too_small_none": ("effects below the floor called none", ""),
    "seconds": ("seconds a case, median", "<= 15"),
}


def number(entry: dict[str, Any]) -> str:
    """A figure with its 95 % interval."""
    if entry["value"] is None:
        return "none to judge"
    low, high = entry["interval_95"]
    return f"{entry['value']:.3g} ({low:.2g} to {high:.2g})"


def table(found: dict[str, Any]) -> str:
    """Figures, sizes, effects and rivals."""
    seal = found["seal"]
    cases = ", ".join(f"{n} {t}" for t, n in found["cases"].items())
    lines = [
        f"Sealed set {seal['sha256'][:12]} ({seal['status']}): {cases}.",
        "",
        "| figure | to reach | found (95 % interval) | cases |",
        "|---|---|---|---|",
    ]
    for key, (words, goal) in FIGURES.items():
        entry = found["table"].get(key)
        if entry is None:  # a set scored before there was this figure
            continue
        lines.append(f"| {words} | {goal} | {number(entry)} | {entry.get('cases', entry['count'])} |")
    lines += ["", "| rival | false alarms | named right | names what is outside |", "|---|---|---|---|"]
    for name, entry in found["rivals"].items():
        row = " | ".join(number(entry[k]) for k in ("false_alarms", "named_right", "outside_named"))
        lines.append(f"| {name} | {row} |")
    lines += ["", "| size of the effect | cases | above floor | named | set | BIC | all at once | cosine |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for row in found["by_size"]:
        rates = [row[k]["value"] for k in ("named", "set", "bic", "all_at_once", "cosine")]
        shown = " | ".join("-" if v is None else f"{v:.2f}" for v in rates)
        span = f"{row['from']:g} to {row['to']:g}"
        lines.append(f"| {span} | {row['named']['count']} | {row['above']} | {shown} |")
    return "\n".join(lines)
