"""Tables of docs/sweeps.md, written between its markers from the results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- sweeps: tables begin -->", "<!-- sweeps: tables end -->"
METHODS = {"paper": "baseline", "hindsight": "baseline, best in hindsight",
           "unconstrained": "unconstrained HMM", "ours": "ours"}  # fmt: skip
# Measure: title, factor to its printed unit, digits, whether more is better.
MEASURES = {
    "boundary_median": ("boundary error, median [ms]", 1e3, 1, False),
    "boundary_95": ("boundary error, 95 % [ms]", 1e3, 0, False),
    "accuracy": ("samples in the right state [%]", 100, 2, True),
    "weight": ("weight error, median [%]", 100, 2, False),
    "width": ("width error, median [%]", 100, 3, False),
    "height": ("height error, median [%]", 100, 3, False),
}
COLUMNS = {
    "boundary error, median / 95 % [ms]": ("boundary_median", "boundary_95"),
    "samples in the right state [%]": ("accuracy",),
    "median error of weight / width / height [%]": ("weight", "width", "height"),
}
LEVELS: dict[str, Callable[[float], str]] = {
    "noise": lambda v: f"noise ×{v:g}", "unstated": lambda v: f"noise ×{v:g}, not stated",
    "rate": lambda v: f"{v:g} Hz", "pace": lambda v: f"pace ×{v:g}", "vibration": lambda v: f"{v:g} N",
    "missing": lambda v: f"{100 * v:g} % missing", "grasp": lambda v: f"{1000 * v:+g} mm",
}  # fmt: skip
TITLES = {"noise": "Sensor noise", "unstated": "Sensor noise that the rig does not state",
          "rate": "Sampling rate", "pace": "Rate of work", "vibration": "Vibration after contact",
          "missing": "Missing values", "grasp": "Height of the grip over the block's centre"}  # fmt: skip
COVERAGE = {"coverage_90": ("boundary intervals, 90 %", 0.90),
            "coverage_95": ("property intervals, 95 %", 0.95)}  # fmt: skip


def fill(document: Path, results: Path) -> None:
    """Write the tables of a results file into a document."""
    found = json.loads(results.read_text(encoding="utf-8"))
    text = document.read_text(encoding="utf-8")
    document.write_text(between(text, "\n\n".join(sections(found))), encoding="utf-8")


def between(text: str, tables: str) -> str:
    """Text with what lies between the markers replaced; ValueError where a marker is missing."""
    if BEGIN not in text or END not in text:
        raise ValueError(f"marker {BEGIN} or {END} is missing")
    before, rest = text.split(BEGIN, 1)
    return f"{before}{BEGIN}\n\n{tables}\n\n{END}{rest.split(END, 1)[1]}"


def sections(found: dict[str, Any]) -> Iterator[str]:
    """All tables, in order."""
    cells = found["cells"]
    yield f"From commit {', '.join(found['commits'])}; {found['cpu_minutes']:g} minutes of one core."
    yield "## Noise and threshold"
    for key in ("boundary_median", "accuracy", "weight"):
        yield _plane(found, key)
    for sweep, rows in found["sweeps"].items():
        if not rows:
            continue
        trials = sorted({cells[row["cell"]]["trials"] for row in rows})
        yield f"## {TITLES[sweep]}\n\nTrials a cell: {' or '.join(map(str, trials))}."
        yield from _lines(found, sweep)
        yield _coverage(found, sweep)
    yield "## Sampled and Laplace posterior"
    yield _sampled(found)
    yield "## Where ours loses"
    yield _losses(found)


def method(cell: dict[str, Any], name: str) -> dict[str, Any]:
    """Measures of a method of METHODS in a cell; `paper` is the baseline at the paper's thresholds."""
    methods = cell["methods"]
    return methods["qualitative"][len(methods["qualitative"]) // 2] if name == "paper" else methods[name]


def _printed(entry: dict[str, Any] | None, key: str, interval: bool = True) -> str:
    _, factor, digits, _ = MEASURES[key]
    if entry is None:
        return ""
    if entry["value"] is None:
        return "none"
    value = f"{factor * entry['value']:.{digits}f}"
    if not interval:
        return value
    low, high = ("none" if v is None else f"{factor * v:.{digits}f}" for v in entry["interval_95"])
    return f"{value} ({low} to {high})"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _plane(found: dict[str, Any], key: str) -> str:
    title = MEASURES[key][0]
    header = [title, *(f"×{f:g}" for f in found["thresholds"]), "best in hindsight", "unconstrained", "ours"]
    rows = []
    for row in found["sweeps"]["noise"]:
        cell = found["cells"][row["cell"]]
        entries = [*cell["methods"]["qualitative"],
                   *(cell["methods"][name] for name in ("hindsight", "unconstrained", "ours"))]  # fmt: skip
        rows.append([LEVELS["noise"](row["level"]), *(_printed(e[key], key, False) for e in entries)])
    return _table(header, rows)


def _lines(found: dict[str, Any], sweep: str) -> Iterator[str]:
    """Three tables of one sweep: boundaries, states, properties; one column a method."""
    for title, keys in COLUMNS.items():
        formulas = ["paper's formulas, true spans"] if "weight" in keys else []
        rows = []
        for row in found["sweeps"][sweep]:
            cell = found["cells"][row["cell"]]
            entries = [method(cell, name) for name in METHODS]
            entries += [cell["methods"]["true_spans"]] if formulas else []
            rows.append([LEVELS[sweep](row["level"]), *(_joined(entry, keys) for entry in entries)])
        yield _table([title, *METHODS.values(), *formulas], rows)


def _joined(entry: dict[str, Any], keys: Sequence[str]) -> str:
    """Values of several measures; a single one, and the first of boundaries, with its interval."""
    whole = len(keys) < 3
    return " / ".join(_printed(entry.get(key), key, whole and i == 0) for i, key in enumerate(keys))


def _coverage(found: dict[str, Any], sweep: str) -> str:
    keys = ("coverage_90", "coverage_95", *(f"coverage_95_{p}" for p in ("weight", "width", "height")),
            "complete")  # fmt: skip
    header = ["coverage by ours [%]", "boundaries, 90 %", "properties, 95 %", "weight", "width", "height",
              "trials that fit"]  # fmt: skip
    rows = []
    for row in found["sweeps"][sweep]:
        ours = found["cells"][row["cell"]]["methods"]["ours"]
        rows.append([LEVELS[sweep](row["level"]), *(_share(ours[key]) for key in keys)])
    return _table(header, rows)


def _share(entry: dict[str, Any]) -> str:
    if entry["value"] is None:
        return "none"
    low, high = (f"{100 * v:.0f}" for v in entry["interval_95"])
    return f"{100 * entry['value']:.1f} ({low} to {high})"


def _sampled(found: dict[str, Any]) -> str:
    header = [
        "cell",
        "trials",
        "converged",
        "coverage 95 %, sampled [%]",
        "coverage 95 %, Laplace [%]",
        "shift of the median, rms [Laplace sd]",
        "width of the interval over Laplace's: 5 %, median, 95 %",
    ]
    rows = []
    for key, cell in found["cells"].items():
        s = cell["sampled"]
        if s["trials"]:
            rows.append([key, str(s["trials"]), str(s["converged"]), f"{100 * s['coverage_95']:.0f}",
                         f"{100 * s['laplace_coverage_95']:.0f}", f"{s['shift_rms']:.2f}",
                         ", ".join(f"{q:.2f}" for q in s["width_ratio"])])  # fmt: skip
    return _table(header, rows)


def losses(found: dict[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Cells where a rival's interval lies wholly on the better side of ours: cell, measure, both values."""
    for name, cell in found["cells"].items():
        ours = cell["methods"]["ours"]
        for key, (title, _, _, more) in MEASURES.items():
            for rival, rival_title in METHODS.items():
                theirs = method(cell, rival).get(key)
                if rival == "ours" or theirs is None:
                    continue
                if _better(theirs["interval_95"], ours[key]["interval_95"], more):
                    yield name, title, rival_title, _printed(theirs, key), _printed(ours[key], key)


def _better(theirs: Sequence[float | None], ours: Sequence[float | None], more: bool) -> bool:
    low, high = (float("inf") if v is None else v for v in theirs)
    our_low, our_high = (float("inf") if v is None else v for v in ours)
    return low > our_high if more else high < our_low


def _losses(found: dict[str, Any]) -> str:
    header = ["cell", "measure", "rival", "rival's", "ours"]
    lost = _table(header, list(losses(found)))
    short = [
        [name, what, _share(entry)]
        for name, cell in found["cells"].items()
        for key, (what, target) in COVERAGE.items()
        if (entry := cell["methods"]["ours"][key])["value"] is not None
        and not entry["interval_95"][0] <= target <= entry["interval_95"][1]
    ]
    off = _table(["cell", "of", "covered [%]"], short)
    return f"{lost}\n\nIntervals that cover too little or too much:\n\n{off}"
