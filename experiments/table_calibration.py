"""docs/tables: do intervals hold, on recordings and in worlds that differ?"""

from __future__ import annotations

from typing import Any

from experiments.scoring import PROPERTIES
from experiments.table_text import covered, load, markdown, milliseconds, percent

SETS = {
    "bank": "Virtual model, fresh seeds",
    "recordings": "Stand-in recordings, healthy",
    "systematic": "Hands that deviate as [systematic] says",
}


def _covered(row: dict[str, Any], level: str) -> str:
    share, error = row[f"coverage_{level}"], row[f"se_{level}"]
    return "" if share is None else f"{100 * share:.0f} ± {100 * error:.0f} %"


def worlds() -> str | None:
    """Worlds that differ, a row each; `needed`: the factor at which intervals hold as stated."""
    found = load("calibration_worlds")
    if found is None:
        return None
    rows = []
    for name, s in found["rows"].items():
        rms = [percent(s[p]["rms"], 2) if p in s else "" for p in PROPERTIES]
        needed = ["" if s[k] is None else f"x{s[k]:.2f}" for k in ("needed_95", "needed_90")]
        cover = [_covered(s, level) for level in ("68", "95", "90")]
        median = "" if s["boundary_median"] is None else milliseconds(s["boundary_median"])
        cells = [*rms, *cover[:2], needed[0], cover[2], needed[1], median]
        rows.append([name, f"{s['trials']} ({s['misfits']})", *cells])
    head = ["world", "trials (misfits)", *(f"{p} rms" for p in PROPERTIES), "68 % cover", "95 % cover",
            "needed", "boundaries, 90 % cover", "needed", "median"]  # fmt: skip
    return markdown(head, rows)


def sbc() -> str | None:
    """Ranks of drawn data sets."""
    found = load("sbc")
    if found is None:
        return None
    rows = [[prop, f"{s['count']}", f"{s['p_value']:.2f}", percent(s["coverage_68"], 1),
             percent(s["coverage_95"], 1)] for prop, s in found["properties"].items()]  # fmt: skip
    return markdown(["property", "data sets", "p of uniform ranks", "68 % cover", "95 % cover"], rows)


def calibration() -> str | None:
    """Coverages by kind of boundary and property, and Laplace beside sampling."""
    found = load("calibration")
    if found is None:
        return None
    parts = []
    for name, title in SETS.items():
        if name not in found:
            continue
        for size, of in (("pooled", "four trials pooled"), ("single", "single trials")):
            s = found[name][size]
            parts.append(f"### {title}: {of} ({s['estimates']} estimates)")
            head = ["boundary", "number", "shift", "median error", "95th percentile", "90 % intervals cover"]
            rows = []
            for kind, b in s["boundaries"].items():
                times = [milliseconds(b[k]) for k in ("bias", "median", "percentile_95")]
                rows.append([kind, f"{b['count']}", *times, covered(b, "coverage_90")])
            parts.append(markdown(head, rows))
            head = ["property", "number", "rms error", "68 % cover", "Laplace", "95 % cover", "Laplace"]
            rows = []
            for key, p in s["properties"].items():
                shares = ("coverage_68", "laplace_68", "coverage_95", "laplace_95")
                rows.append([key, f"{p['count']}", percent(p["rms"], 3), *(covered(p, c) for c in shares)])
            parts.append(markdown(head, rows))
    return "\n\n".join(parts)
