"""The diagnosis in labs drawn anew: false alarms on healthy recordings, single effects named, default flags.

    python -m experiments.blind_check open --cases 30 --tiers healthy single --seed S --out FOLDER
    python -m experiments.gap_drawn FOLDER [--part K/N]

A case ends in FOLDER/CASE/diagnosis.json, so that a run may be stopped and started again, and parts may
run beside each other. Nothing is sealed: the seed is one that nobody looked at before, and what is changed
by what comes out is judged on another.
Writes experiments/results/gap_drawn.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.blind_check.diagnose import diagnose_folder
from experiments.blind_check.statistics import proportion
from experiments.saving import save
from experiments.table_text import load, markdown, percent

RESULT = Path(__file__).parent / "results" / "gap_drawn.json"
FLOOR = 5.0  # nats that the true effect gains by itself, below which it need not be seen


def outcome(label: dict[str, Any], found: dict[str, Any]) -> str:
    """What became of a case: `quiet`, `false alarm`, `named`, `set`, `beside others`, `too small`, `unknown`,
    `wrong name`, `missed`, `error`."""
    if "error" in found:
        return "error"
    verdict = found["verdict"]
    if label["tier"] == "healthy":
        return "quiet" if verdict == "none" else "false alarm"
    (true,) = label["effects"]
    if verdict == "none":
        return "too small" if found.get("small_gap") else "missed"
    if verdict == "unknown":
        return "unknown"
    if found["causes"] == [true]:
        return "named" if verdict == "named" else "set"
    if true in found["causes"]:
        return "beside others"
    return "set" if true in found["indistinguishable"] and len(found["causes"]) == 1 else "wrong name"


def row(label: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """A case's diagnosis in short; `gain` [nats] of the true effect by itself, None where it scatters."""
    gains = found.get("gains", {})
    return {
        "case": label["case"], "tier": label["tier"], "effects": label["effects"],
        "outcome": outcome(label, found), "verdict": found.get("verdict"), "causes": found.get("causes", []),
        "p_value": found.get("detection", {}).get("p_value"), "gain": gains.get(label["effects"][0]),
        "seconds": round(found["seconds"], 1),
    }  # fmt: skip


def table() -> str | None:
    """docs/gap_results.md: outcomes in labs drawn anew."""
    found = load("gap_drawn")
    if not isinstance(found, dict):
        return None
    rows = found["rows"]
    healthy = [r for r in rows if r["tier"] == "healthy"]
    single = [r for r in rows if r["tier"] == "single" and (r["gain"] is None or r["gain"] >= FLOOR)]

    def share(of: Sequence[dict[str, Any]], *which: str) -> list[str]:
        p = proportion([r["outcome"] in which for r in of])
        low, high = p["interval_95"]
        return [f"{p['hits']} of {p['count']}", f"{percent(low, 0)} to {percent(high, 0)}"]

    lines = [
        ["false alarms on healthy recordings", "<= 1 %", *share(healthy, "false alarm", "error")],
        ["single effects named, no other beside them", ">= 90 %", *share(single, "named")],
        ["named alone, or in a set", "", *share(single, "named", "set")],
        ["named, others beside it", "", *share(single, "beside others")],
        ["too small to matter, said so", "", *share(single, "too small")],
        ["unknown", "", *share(single, "unknown")],
        ["not noticed", "", *share(single, "missed")],
        ["another name", "", *share(single, "wrong name")],
    ]
    cost = sorted(r["seconds"] for r in rows)[len(rows) // 2]
    named = ", ".join(
        f"{r['effects'][0]} ({r['outcome']}: {' + '.join(r['causes'])})"
        for r in single
        if r["outcome"] in ("wrong name", "beside others")
    )
    few = sum(r["tier"] == "single" for r in rows) - len(single)
    return (
        markdown(["figure", "to reach", "found", "95 % interval"], lines)
        + f"\n\nSeed {found['seed']}; code of {found['made_by']}; effects that gain {FLOOR:.0f} nats at "
        f"least by themselves ({few} do not); {cost:.0f} s of processor a case in the median, healthy twins "
        f"included. With others beside them, or another name: {named or 'none'}."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True, help="what the folder was drawn with")
    parser.add_argument("--part", default="0/1")
    options = parser.parse_args(arguments)
    labels = json.loads((options.folder / "labels.json").read_text(encoding="utf-8"))
    part, parts = map(int, options.part.split("/"))
    for label in labels[part::parts]:
        file = options.folder / label["case"] / "diagnosis.json"
        if not file.exists():
            file.write_text(json.dumps(diagnose_folder(file.parent)) + "\n", encoding="utf-8")
        found = row(label, json.loads(file.read_text(encoding="utf-8")))
        print(found["case"], *found["effects"], "->", found["outcome"], *found["causes"], found["p_value"],
              found["seconds"], "s", flush=True)  # fmt: skip
    done = [(label, options.folder / label["case"] / "diagnosis.json") for label in labels]
    rows = [row(label, json.loads(f.read_text(encoding="utf-8"))) for label, f in done if f.exists()]
    if len(rows) == len(labels):
        save(RESULT, {"rows": rows, "seed": options.seed})


if __name__ == "__main__":
    main()
