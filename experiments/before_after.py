"""Published numbers before and after the inside was rebuilt: boundaries, properties and their intervals.

    git worktree add /tmp/before c02f51d
    python -m experiments.before_after measure before --root /tmp/before --package commands FOLDER...
    python -m experiments.before_after measure after --root . --package hmmseg_cli FOLDER...
    python -m experiments.before_after

FOLDER holds cases as recordings/ does. `measure` runs `identify` of the code in --root on every case, all its
trials pooled, and keeps what it found with that code's commit; without arguments both are compared with
each other and with the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.recordings import Case, list_cases, read_case
from experiments.saving import commit_of, save
from experiments.table_text import RESULTS, load, markdown

OUT = RESULTS / "before_after.json"
PROPERTIES = ("weight", "width", "height")
# What runs in the other code, which may lack everything that this one has.
RUNNER = """
import sys
from importlib import import_module
main = import_module(sys.argv[1] + ".main").main
for k, case in enumerate(sys.argv[3:]):
    from pathlib import Path
    folder, out = Path(case), Path(sys.argv[2]) / f"{k}.json"
    trials = [str(path) for path in sorted(folder.glob("trial_*.csv"))]
    print(folder.name, file=sys.stderr)
    main(["identify", *trials, "--task", str(folder / "task.toml"), "--rig", str(folder / "rig.toml"),
          "--json", str(out), "--quiet"])
"""


def measure(root: Path, package: str, folders: Sequence[Path]) -> dict[str, Any]:
    """What the code in `root` finds in every case of the folders."""
    cases = [case for folder in folders for case in list_cases(folder)]
    with tempfile.TemporaryDirectory() as temporary:
        settings = os.environ | {"PYTHONPATH": str(root)}
        command = [sys.executable, "-c", RUNNER, package, temporary, *(str(case.resolve()) for case in cases)]
        subprocess.run(command, check=True, cwd=temporary, env=settings)
        found = {}
        for k, case in enumerate(cases):
            path = Path(temporary) / f"{k}.json"
            if path.exists():
                found[case.name] = kept(json.loads(path.read_text(encoding="utf-8")))
    return {"commit": commit_of(root), "cases": found}


def kept(document: dict[str, Any]) -> dict[str, Any]:
    """Of identify's document: boundaries with their 90 % intervals, properties with their 95 % intervals."""
    trials = [
        [[round(s["start"], 5), *(round(x, 5) for x in s["start_90"])] for s in trial["segments"][1:]]
        if trial["complete"]
        else None
        for trial in document["trials"]
    ]
    properties = {}
    for name, entries in document["properties"].items():
        for key in PROPERTIES:
            entry = entries.get(key)
            if entry is not None:
                values = (entry["mean"], entry["sd"], *entry["interval_95"])
                properties[f"{name}.{key}"] = [float(f"{value:.7g}") for value in values]
    return {"trials": trials, "properties": properties}


def compared(case: Case, before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """One case: how far numbers moved, and how far both are from the truth where it is known."""
    moved, errors, inside = [], {"before": [], "after": []}, {"before": [], "after": []}
    for truth, old, new in zip(case.truth, before["trials"], after["trials"], strict=True):
        if old is not None and new is not None:
            moved += [abs(a[0] - b[0]) for a, b in zip(old, new, strict=True)]
        for name, rows in (("before", old), ("after", new)):
            if rows is None or truth is None:
                continue
            errors[name] += [abs(row[0] - time) for row, time in zip(rows, truth, strict=True)]
            inside[name] += [low <= time <= high for (_, low, high), time in zip(rows, truth, strict=True)]
    values = []
    for name, old in before["properties"].items():
        new = after["properties"].get(name)
        obj, key = name.split(".")
        known = case.blocks.get(obj, {}).get(key)
        values.append({
            "name": name, "before": old, "after": new, "true": None if known is None else known[0],
        })  # fmt: skip
    values += [
        {"name": name, "before": None, "after": new, "true": None}
        for name, new in after["properties"].items() if name not in before["properties"]
    ]  # fmt: skip
    return {
        "case": case.name, "effects": case.effects, "moved": moved, "errors": errors, "inside": inside,
        "complete": [sum(t is not None for t in found["trials"]) for found in (before, after)],
        "trials": len(case.truth), "properties": values,
    }  # fmt: skip


def table() -> str | None:
    """docs/before_after.md: a row a case, and one for all healthy ones."""
    found = load("before_after")
    if found is None or "compared" not in found:
        return None
    rows = found["compared"]
    head = ["recordings", "trials that fit", "boundaries moved by, median (largest)",
            "median boundary error", "90 % intervals cover", "properties moved by [sd], largest",
            "largest error of weight, width, height", "95 % intervals cover"]  # fmt: skip
    healthy = [row for row in rows if row["effects"] == ["none"]]
    lines = [_line(row["case"], [row]) for row in rows]
    lines.append(_line("all healthy ones", healthy))
    before, after = found["before"]["commit"], found["after"]["commit"]
    note = f"Before: {before}. After: {after}. Two numbers in a cell: before, after."
    return f"{markdown(head, lines)}\n\n{note}"


def _line(name: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    moved = [m for row in rows for m in row["moved"]]
    fits = " and ".join(str(sum(row["complete"][k] for row in rows)) for k in (0, 1))
    errors, covered = [], []
    for k in ("before", "after"):
        every = [e for row in rows for e in row["errors"][k]]
        errors.append(f"{1e3 * np.median(every):.1f}" if every else "-")
        inside = [i for row in rows for i in row["inside"][k]]
        covered.append(f"{100 * np.mean(inside):.0f}" if inside else "-")
    both = [v for row in rows for v in row["properties"] if v["before"] and v["after"]]
    shifts = [abs(v["after"][0] - v["before"][0]) / v["before"][1] for v in both]
    largest = []
    for key in PROPERTIES:
        known = [v for v in both if v["true"] is not None and v["name"].endswith(key)]
        worst = [
            max((abs(v[k][0] / v["true"] - 1) for v in known), default=np.nan) for k in ("before", "after")
        ]
        largest.append(", ".join(f"{100 * w:.2f}" for w in worst))
    held = []
    for k in ("before", "after"):
        known = [v for v in both if v["true"] is not None]
        inside = [v[k][2] <= v["true"] <= v[k][3] for v in known]
        held.append(f"{sum(inside)} of {len(inside)}")
    return [
        name, f"{fits} of {sum(row['trials'] for row in rows)}",
        f"{1e3 * np.median(moved):.2f} ({1e3 * np.max(moved):.1f}) ms" if moved else "-",
        f"{', '.join(errors)} ms", f"{', '.join(covered)} %", f"{max(shifts):.2f}" if shifts else "-",
        "; ".join(largest) + " %", ", ".join(held),
    ]  # fmt: skip


def main(args: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="?", choices=["measure", "compare"], default="compare")
    parser.add_argument("side", nargs="?", choices=["before", "after"])
    parser.add_argument("--root", type=Path, default=Path())
    parser.add_argument("--package", default="hmmseg_cli")
    parser.add_argument("folders", nargs="*", type=Path)
    given = parser.parse_intermixed_args(args)
    found = load("before_after") or {}
    if given.what == "measure":
        found[given.side] = measure(given.root.resolve(), given.package, given.folders)
        found["folders"] = [folder.name for folder in given.folders]
    cases = {path.name: path for folder in given.folders for path in list_cases(folder)}
    if given.folders and {"before", "after"} <= found.keys():
        before, after = (found[side]["cases"] for side in ("before", "after"))
        found["compared"] = [
            compared(read_case(path), before[name], after[name])
            for name, path in cases.items() if name in before and name in after
        ]  # fmt: skip
    save(OUT, found)


if __name__ == "__main__":
    main()
