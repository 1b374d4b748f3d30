"""Tables of the diagnosis: labelled recordings and the blind check."""

from __future__ import annotations

from typing import Any

from experiments.blind_check.tables import goals
from experiments.blind_check.tables import table as check_table
from experiments.table_text import load, markdown, percent


def diagnosed() -> list[dict[str, Any]] | None:
    """Diagnoses of labelled recordings by the present engine; None where there are none."""
    found = load("gap_recordings")
    return found["rows"] if isinstance(found, dict) else None


def recordings() -> str | None:
    """docs/gap_results.md: verdicts on labelled recordings."""
    rows = diagnosed()
    if rows is None:
        return None
    head = ["recording", "verdict without `actual`", "with `actual`", "parameters found (90 % interval)",
            "true", "time"]  # fmt: skip
    return markdown(head, [_row(row) for row in rows])


def _row(row: dict[str, Any]) -> list[str]:
    found = {k: v for k, v in row["actual"]["parameters"].items() if len(row["actual"]["parameters"]) <= 4}
    values = "; ".join(
        f"{k} {mean:.4g} {unit} ({low:.4g} to {high:.4g})" for k, (mean, low, high, unit) in found.items()
    )
    truth = "; ".join(f"{k} {_shown(v)}" for k, v in row["truth"].items())
    return [row["case"], _verdict(row["blind"]), _verdict(row["actual"]), values, truth,
            f"{row['blind']['processor']:.0f} s"]  # fmt: skip


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return "(" + ", ".join(_shown(v) for v in value) + ")"
    return f"{value:.4g}" if isinstance(value, int | float) else str(value)


def _verdict(found: dict[str, Any]) -> str:
    if found["verdict"] == "set":
        return f"set: {', '.join(found['causes'] + found['partners'])}"
    return " + ".join(found["causes"]) or found["verdict"]


def summary() -> str | None:
    """docs/results.md: how often the diagnosis is right."""
    rows = diagnosed()
    if rows is None:
        return None
    affected = [r for r in rows if r["effects"]]
    healthy = [r for r in rows if not r["effects"]]
    right = {
        k: sum(r[k]["causes"] == r["effects"] and r[k]["verdict"] == "named" for r in affected)
        for k in ("blind", "actual")
    }
    sets = sum(
        r["blind"]["verdict"] == "set" and r["effects"][0] in [*r["blind"]["causes"], *r["blind"]["partners"]]
        for r in affected
    )
    quiet = sum(r["blind"]["verdict"] == "none" and r["actual"]["verdict"] == "none" for r in healthy)
    blind = fresh()
    check = "" if blind is None else _blind(blind)
    slowest = max(r["blind"]["processor"] for r in rows)
    return (
        f"On {len(rows)} labelled recordings of the stand-in, which were in view while it was built: "
        f"{quiet} of {len(healthy)} healthy ones called healthy, of {len(affected)} with one effect "
        f"{right['blind']} named without knowing the blocks' properties ({sets} more as a set that holds "
        f"the cause), {right['actual']} with them; {slowest:.0f} s of processor at most for four trials."
        f"{check}"
    )


def _blind(found: dict[str, Any]) -> str:
    """The blind check in a few sentences."""
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


def fresh() -> dict[str, Any] | None:
    """The last blind check, unless its set is one of those that judge nothing any more."""
    found, spent = load("blind_check"), load("blind_sets")
    if found is None or found["seal"]["sha256"] in {one["seal"] for one in (spent or {"sets": []})["sets"]}:
        return None
    return found


def blind() -> str | None:
    """docs/gap_results.md: the figures of the blind check."""
    found = fresh()
    return None if found is None else goals(found)


def blind_by_circumstance() -> str | None:
    """docs/tables/blind.csv: the same by circumstance, size and effect."""
    found = fresh()
    return None if found is None else check_table(found)
