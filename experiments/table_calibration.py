"""docs/tables: do intervals hold, on recordings, in worlds that differ, against NUTS?"""

from __future__ import annotations

from typing import Any

from experiments.estimates import KINDS
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


def identified_boundaries() -> str | None:
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


def boundaries() -> str | None:
    """Boundaries of single trials in worlds that differ."""
    found = load("calibration_boundaries")
    if found is None:
        return None
    rows = []
    for name, entry in found["rows"].items():
        every = entry["all"]
        cells = [f"{every[k]:.1f} ms" for k in ("median", "percentile_95")]  # saved in ms
        cells += [percent(every["coverage_90"], 0), f"{every['half_width']:.1f} ms"]
        rows.append([name, f"{entry['trials']} ({entry['misfits']})", *cells])
    head = ["world", "trials (misfits)", "median error", "95 % of errors below", "90 % cover", "half width"]
    return markdown(head, rows)


def boundaries_by_kind() -> str | None:
    """The factor by which intervals would hold 90 %, and how many hold, by kind of boundary and rate."""
    found = load("calibration_boundaries")
    if found is None:
        return None
    rows = []
    for name, entry in found["rows"].items():
        if name.endswith(" Hz") and "," not in name:
            of = [entry[kind] for kind in KINDS]
            needed = [k["percentile_90"] / k["half_width"] for k in of]
            cells = [f"x{n:.2f} ({percent(k['coverage_90'], 0)})" for n, k in zip(needed, of, strict=True)]
            rows.append([name, *cells])
    return markdown(["world", *KINDS], rows)


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


def moves() -> str | None:
    """The sampler's moves."""
    found = load("benchmark_moves")
    if found is None:
        return None
    rows = []
    for size, of in found["trials"].items():
        for name, row in of.items():
            tau, speed = f"{row['autocorrelation_time']:.1f}", f"{row['ess_per_second']:.0f}"
            rows.append([name, size, f"{row['acceptance']:.2f}", tau, speed])
    head = ["moves", "trials", "acceptance", "autocorrelation time", "effective samples a second"]
    return markdown(head, rows)
