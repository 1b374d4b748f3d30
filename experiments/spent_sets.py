"""One table of the spent blind sets, from the result files as they were committed.

    python -m experiments.spent_sets

The full file of each set stays in the history of this repository: `git show COMMIT:PATH`. The table holds its
figures, and its SHA-256 so that whoever fetches it knows that it is the one.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path
from typing import Any

from experiments.saving import save
from experiments.table_text import RESULTS, load, markdown

ROOT = Path(__file__).parents[1]
COMMIT = "c02f51d3edc81b8cc6de77ed07ac416413aab873"  # chosen: the last commit that holds all these files
# chosen: as they were scored
ORDER = [
    "first",
    "second",
    "third",
    "fourth",
    "fifth",
    "sixth",
    "seventh",
    "eighth",
    "ninth",
    "tenth",
    "eleventh",
    "twelfth",
]
SHOWN = {
    "false_alarms": "false alarms on healthy recordings",
    "named_right": "named effect right, above the floor",
    "set_right": "right set, above the floor",
    "outside_unknown": "outside the catalogue -> unknown",
    "withheld_right": "effect taken out -> unknown or its partners",
    "pair_exact": "two effects, exact pair",
    "coverage_90": "90 % intervals of parameters cover",
    "location_f1": "location: F1 over channel x subtask",
    "calibration_error": "calibration error",
}


def spent_set(name: str) -> dict[str, Any]:
    """One set: where its file lies, its hash, seal, code, number of cases, figures and rivals."""
    last = "" if name == ORDER[-1] else f"_{name}"
    path = f"experiments/results/blind_check{last}.json"
    content = subprocess.run(
        ["git", "show", f"{COMMIT}:{path}"], cwd=ROOT, check=True, capture_output=True
    ).stdout
    found = json.loads(content)
    return {
        "name": name,
        "file": path,
        "commit": COMMIT,
        "sha256": hashlib.sha256(content).hexdigest(),
        "seal": found["seal"]["sha256"],
        "code": found["code"],
        "cases": found["cases"],
        "above_floor": found["above_floor"],
        "table": found["table"],
        "rivals": found["rivals"],
    }


def table() -> str | None:
    """docs/history.md: the figures of every spent set."""
    found = load("blind_sets")
    if found is None:
        return None
    head = ["set", "cases", *SHOWN.values(), "SHA-256 of the file"]
    rows = []
    for one in found["sets"]:
        row = [one["name"], f"{sum(one['cases'].values())}"]
        for key in SHOWN:
            entry = one["table"][key]
            if key == "false_alarms":
                row.append(f"{entry['hits']} of {entry['count']}")
            else:
                row.append("-" if entry["value"] is None else f"{entry['value']:.2g}")
        rows.append([*row, f"`{one['sha256'][:16]}`"])
    return markdown(head, rows)


def main() -> None:
    sets = [spent_set(name) for name in ORDER]
    out = RESULTS / "blind_sets.json"
    save(out, {"sets": sets})
    print(f"{out.name}: {len(sets)} sets")


if __name__ == "__main__":
    main()
