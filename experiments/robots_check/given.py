"""Cases by another generator, diagnosed as by a user, and scored.

    python -m experiments.robots_check.given FOLDER [CASE...]    # results/robots_check_given.json

A case is a folder with robot.xml, map.toml, train_*.csv (fitted), held_*.csv (never seen before the end) and
truth.json: `right`, a list of causes, each as names of which any is right; none for a healthy robot;
"unknown" for what no catalogue has.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from experiments.benchmarks.commands import processor
from experiments.saving import save

OUT = Path(__file__).resolve().parents[1] / "results" / "robots_check_given.json"


def diagnosed(case: Path) -> dict[str, Any]:
    """The document, with the command's processor time [s]."""
    with tempfile.TemporaryDirectory() as place:
        target = Path(place) / "found.json"
        logs = [str(p) for p in sorted(case.glob("train_*.csv"))]
        model = ["--model", str(case / "robot.xml"), "--map", str(case / "map.toml")]
        command = ["-m", "hmmseg_cli.main", "diagnose", *logs, *model, "--json", str(target), "--quiet"]
        seconds = processor(command)
        return json.loads(target.read_text(encoding="utf-8")) | {"seconds": seconds}


SINCE = {"cogging": "cogging", "flexible": "elasticity"}  # look: effects added after the answers were written


def right(found: dict[str, Any], truth: list[list[str]], case: str) -> bool:
    """Whether each true cause is named, or in the set, and nothing else is named."""
    if not truth:
        return found["verdict"] == "none"
    if truth == [["unknown"]]:
        own = [name.rpartition(".")[2] for name in found["causes"]]
        return found["verdict"] == "unknown" or own == [SINCE.get(case)]
    named = {*found["causes"], *found["indistinguishable"]}
    allowed = {name for each in truth for name in each}
    met = all(named & {*each} for each in truth)
    return found["verdict"] in ("named", "set") and met and bool({*found["causes"]} & allowed)


def main() -> None:
    """Diagnose, score, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--output", type=Path, default=OUT)
    given = parser.parse_args()
    out = {}
    for truth in sorted(given.folder.glob("*/truth.json")):
        case = truth.parent
        if given.cases and case.name not in given.cases:
            continue
        found, wanted = diagnosed(case), json.loads(truth.read_text(encoding="utf-8"))["right"]
        values = {
            f"{cause}.{short}": p["mean"] for cause in found["causes"]
            for short, p in found["effects"][cause]["parameters"].items()
        }  # fmt: skip
        out[case.name] = {
            "right": right(found, wanted, case.name), "truth": wanted,
            "verdict": found["verdict"], "causes": values, "indistinguishable": found["indistinguishable"],
            "seconds": round(found["seconds"], 1), "over_noise": found["remainder"]["rms_over_noise"],
        }  # fmt: skip
        print(case.name, json.dumps(out[case.name]), flush=True)
    save(given.output, out)


if __name__ == "__main__":
    main()
