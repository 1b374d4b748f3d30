"""The diagnosis on labelled recordings of a stand-in rig: verdict, parameters against the truth, time.

    python -m experiments.gap_recordings RECORDINGS

Four trials of every case, without `--actual` and with it, in one warm process. These recordings were in
view while the diagnosis was built: they show that it works, the blind check shows how well. Writes
experiments/results/gap_recordings.json.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estimation.actual import read_actual
from experiments.recordings import Case, list_cases, read_case
from simgap.gap.diagnose import diagnose

RESULT = Path(__file__).parent / "results" / "gap_recordings.json"
TRIALS = 4


def summary(case: Case, folder: Path, measured: bool) -> dict[str, Any]:
    """What one diagnosis found, and the processor and wall seconds it took."""
    actual = read_actual(folder / "actual.toml", case.task.objects) if measured else None
    start, busy = time.perf_counter(), time.process_time()
    body = diagnose(case.trials[:TRIALS], case.task, case.rig, actual).body
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", type=Path)
    folder = parser.parse_args(arguments).recordings
    labels = {e["case"]: e for e in json.loads((folder / "labels.json").read_text(encoding="utf-8"))}
    cases = {path.name: (read_case(path), path) for path in list_cases(folder)}
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
    RESULT.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
