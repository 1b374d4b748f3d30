"""The diagnosis on labelled recordings of a stand-in rig: verdict, parameters against the truth, time.

    python -m experiments.gap_recordings RECORDINGS [--json FILE]

Four trials of every case, without `--actual` and with it, in one warm process. These recordings were in
view while the diagnosis was built: they show that it works, the blind check shows how well. Writes
experiments/results/gap_recordings.json (FILE with --json).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estimation.report import read_actual
from experiments.blind_check.tables import describe as describe_blind
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from experiments.table_text import markdown
from hmmseg.segmentation.align import align
from simgap.gap.diagnose import diagnose

RESULT = Path(__file__).parent / "results" / "gap_recordings.json"
TRIALS = 4


def summary(case: Case, folder: Path, measured: bool) -> dict[str, Any]:
    """Summary of a diagnosis, with its processor and wall time [s]."""
    actual = read_actual(folder / "actual.toml", case.task.objects) if measured else None
    start, busy = time.perf_counter(), time.process_time()
    aligned = align(case.trials[:TRIALS], case.task, case.rig)
    body = diagnose(aligned, actual).body
    wall, busy = time.perf_counter() - start, time.process_time() - busy
    best = body["effects"].get("+".join(body["causes"]), {"parameters": {}})
    return {
        "verdict": body["verdict"], "causes": body["causes"], "partners": body["indistinguishable"],
        "p_value": body["detection"]["p_value"],
        "probability": body["probabilities"].get("+".join(body["causes"]) or body["verdict"], 0.0),
        "parameters": {k: [p["mean"], *p["interval_90"], p["unit"]] for k, p in best["parameters"].items()},
        "shrinkage": body["shrinkage"] and body["shrinkage"]["fraction"],
        "wall": round(wall, 1), "processor": round(busy, 1),
    }  # fmt: skip


def table(found: dict) -> str:
    """docs/gap_results.md: verdicts on labelled recordings."""
    head = ["recording", "verdict without `actual`", "with `actual`", "parameters found (90 % interval)",
            "true", "time"]  # fmt: skip
    return markdown(head, [_row(row) for row in found["rows"]])


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


def describe(found: dict) -> str:
    """docs/results.md: how often the diagnosis is right."""
    rows = found["rows"]
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
    slowest = max(r["blind"]["processor"] for r in rows)
    return (
        f"On {len(rows)} labelled recordings of the stand-in, which were in view while it was built: "
        f"{quiet} of {len(healthy)} healthy ones called healthy, of {len(affected)} with one effect "
        f"{right['blind']} named without knowing the blocks' properties ({sets} more as a set that holds "
        f"the cause), {right['actual']} with them; {slowest:.0f} s of processor at most for four trials."
        f"{describe_blind()}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args(arguments)
    folder = options.recordings
    labels = {e["case"]: e for e in json.loads((folder / "labels.json").read_text(encoding="utf-8"))}
    paths = {path.name: path for path in list_cases(folder)}
    cases = {name: (read_case(path), path) for name, path in sorted(paths.items())}
    first = next(iter(cases.values()))
    summary(*first, False)  # compiles
    rows = []
    for name, (case, path) in cases.items():
        label = labels.get(name, {})
        row: dict[str, Any] = {
            "case": name, "effects": [e for e in label.get("effects", []) if e != "none"],
            "truth": label.get("params", {}),
        }  # fmt: skip
        for key, measured in (("blind", False), ("actual", True)):
            row[key] = summary(case, path, measured)
            print(name, key, row[key]["verdict"], row[key]["causes"], row[key]["partners"],
                  row[key]["wall"], "s", flush=True)  # fmt: skip
        rows.append(row)
        save(options.json, {"rows": rows})  # after every case: what is there so far counts


if __name__ == "__main__":
    main()
