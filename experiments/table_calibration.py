"""docs/calibration.md: do intervals hold, on recordings, in worlds that differ, against NUTS."""

from __future__ import annotations

from typing import Any

from experiments.scoring import PROPERTIES
from experiments.table_text import load, markdown, percent


def _covered(row: dict[str, Any], level: str) -> str:
    share, error = row[f"coverage_{level}"], row[f"se_{level}"]
    return "" if share is None else f"{100 * share:.0f} ± {100 * error:.0f} %"


def identified() -> str | None:
    """Recordings of other simulators: errors and coverages by property."""
    found = load("identified")
    if found is None:
        return None
    rows = []
    for name, properties in found.items():
        if name == "made_by":
            continue
        for prop, s in properties.items():
            if prop in PROPERTIES:
                cells = [f"{s['count']} ({s['null']})", percent(s["median"], 3), percent(s["rms"], 3)]
                cells += [f"{s['z_rms']:.2f}", percent(s["coverage_68"], 0), percent(s["coverage_95"], 0)]
                rows.append([name, prop, *cells])
    head = ["recordings, kind, rig file, trials", "property", "estimates (null)", "median error", "rms error",
            "rms of z", "68 % cover", "95 % cover"]  # fmt: skip
    return markdown(head, rows)


def boundaries() -> str | None:
    """Boundaries of the same recordings."""
    found = load("identified")
    if found is None:
        return None
    rows = []
    for name, properties in found.items():
        seen = properties.get("boundaries") if name != "made_by" else None
        if seen is not None:
            cells = [f"{seen['count']}", f"{seen['misfits']}"]
            cells += [f"{1e3 * seen[k]:.1f} ms" for k in ("median", "percentile_95")]
            rows.append([name, *cells, percent(seen["coverage_90"], 0)])
    if not rows:
        return None
    head = ["recordings, kind, rig file, trials", "boundaries", "trials that do not fit", "median error",
            "95 % of errors below", "90 % cover"]  # fmt: skip
    return markdown(head, rows)


def worlds() -> str | None:
    """Worlds that differ, a row each, beside what they were by an earlier code and on other seeds."""
    found, before = load("calibration_worlds"), load("calibration_worlds_before")
    if found is None:
        return None
    rows = []
    for name, s in found["rows"].items():
        was = before["rows"].get(name) if before else None
        earlier = [
            "" if was is None or was[f"coverage_{k}"] is None else percent(was[f"coverage_{k}"], 0)
            for k in ("95", "90")
        ]
        rms = [percent(s[p]["rms"], 2) if p in s else "" for p in ("weight", "width", "height")]
        needed = ["" if s[k] is None else f"x{s[k]:.2f}" for k in ("needed_95", "needed_90")]
        cover = [_covered(s, level) for level in ("68", "95", "90")]
        median = "" if s["boundary_median"] is None else f"{1e3 * s['boundary_median']:.1f} ms"
        cells = [*rms, cover[0], earlier[0], cover[1], needed[0], earlier[1], cover[2], needed[1], median]
        rows.append([name, f"{s['trials']} ({s['misfits']})", *cells])
    head = ["world", "trials (misfits)", "weight rms", "width rms", "height rms", "68 % cover",
            "95 % covered before", "now", "would at", "boundaries, 90 % covered before", "now", "would at",
            "median"]  # fmt: skip
    return markdown(head, rows)


def sbc() -> str | None:
    """Ranks of drawn data sets."""
    found = load("sbc")
    if found is None:
        return None
    rows = [[prop, f"{s['count']}", f"{s['p_value']:.2f}", percent(s["coverage_68"], 1),
             percent(s["coverage_95"], 1)] for prop, s in found["properties"].items()]  # fmt: skip
    return markdown(["property", "data sets", "p of uniform ranks", "68 % cover", "95 % cover"], rows)


def reference() -> str | None:
    """The sampler beside NUTS."""
    found = load("reference_posteriors")
    if found is None:
        return None
    rows = []
    for r in found["tasks"]:
        apart = [f"{r['means']['properties']:.3f}", percent(r["sds"]["properties"], 1)]
        speed = [f"{r[f'{k}ess_per_second']:.0f}" for k in ("", "nuts_", "stretch_")]
        rows.append([f"{r['blocks']}", f"{r['trials']}", *apart, *speed])
    head = ["blocks", "trials", "means apart [sd]", "sds apart", "ours [effective samples a second]", "NUTS",
            "emcee's default move"]  # fmt: skip
    speed = ", ".join(f"{v:.0f} for {k}" for k, v in found["log_densities_a_second"].items())
    return f"{markdown(head, rows)}\n\nLog densities a second, by blocks x trials: {speed}."
