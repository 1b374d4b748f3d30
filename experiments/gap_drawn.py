"""The diagnosis in labs drawn anew: false alarms on healthy recordings, single effects named, default flags.

    python -m experiments.blind_check open --cases 30 --tiers healthy single --seed S --out FOLDER
    python -m experiments.gap_drawn FOLDER --seed S [--part K/N]
    python -m experiments.gap_drawn FOLDER --results DIR --run NAME [--cases CASE ...]

A case ends in FOLDER/CASE/diagnosis.json, so that a run may be stopped and started again, and parts may
run beside each other. Nothing is sealed: the seed is one that nobody looked at before, and what is changed
by what comes out is judged on another. Writes experiments/results/gap_drawn.json.

The second form scores open labs of another simulator (recordings_labs): diagnoses go to DIR/CASE.json, and
the rows of this run stand under NAME in experiments/results/gap_labs.json, beside those of other code.
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
LABS = RESULT.with_name("gap_labs.json")
WEAK = 0.3  # of the gap of held-out trials: causes that explain less are none
FLOOR = 5.0  # nats that the true effect gains by itself, below which it need not be seen


def outcome(label: dict[str, Any], found: dict[str, Any]) -> str:
    """What became of a case: `quiet`, `false alarm`, `named`, `set`, `beside others`, `half` (of a pair),
    `too small`, `unknown`, `wrong name`, `missed`, `error`."""
    if "error" in found:
        return "error"
    verdict = found["verdict"]
    if label["tier"] == "healthy":
        return "quiet" if verdict == "none" else "false alarm"
    if label["tier"] == "outside":
        return {"unknown": "unknown", "none": "missed"}.get(verdict, "wrong name")
    if label["tier"] == "pair":
        both = {*found["causes"]} & {*label["effects"]}
        if {*found["causes"]} == {*label["effects"]}:
            return "named"
        if both:
            return "half"
        return {"none": "missed", "unknown": "unknown"}.get(verdict, "wrong name")
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
        "held_out": (found.get("shrinkage") or {}).get("fraction"),
        "probability": found.get("probabilities", {}).get("+".join(sorted(label["effects"])), 0.0),
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


def labs_table() -> str | None:
    """docs/gap_results.md: open labs of another simulator, one column a version of the code."""
    found = load("gap_labs")
    if not isinstance(found, dict):
        return None
    runs: dict[str, list[dict[str, Any]]] = found["runs"]

    def line(name: str, tiers: Sequence[str], *which: str) -> list[str]:
        cells = []
        for rows in runs.values():
            of = [r for r in rows if r["tier"] in tiers]
            cells.append(f"{sum(r['outcome'] in which for r in of)} of {len(of)}")
        return [name, *cells]

    def weak(rows: Sequence[dict[str, Any]]) -> str:
        named = [r for r in rows if r["verdict"] in ("named", "set")]
        return f"{sum(r['held_out'] is not None and r['held_out'] < WEAK for r in named)} of {len(named)}"

    lines = [
        line("healthy: none", ["healthy"], "quiet"),
        line("single: named alone", ["single"], "named"),
        line("single: named alone, or in a set", ["single"], "named", "set"),
        line("single: others beside it", ["single"], "beside others"),
        line("single: unknown", ["single"], "unknown"),
        line("single: not noticed, or too small to matter", ["single"], "missed", "too small"),
        line("single: another name", ["single"], "wrong name"),
        line("pairs: whole", ["pair"], "named"),
        line("pairs: one of both", ["pair"], "half"),
        line("outside: unknown", ["outside"], "unknown"),
        ["named with a held-out share below 0.3", *(weak(rows) for rows in runs.values())],
        ["seconds of processor, median",
         *(str(round(sorted(r["seconds"] for r in rows)[len(rows) // 2]) or "") for rows in runs.values())],
    ]  # fmt: skip
    wrong = [
        f"{r['case']} {' + '.join(r['effects'])} ({r['outcome']}{': ' if r['causes'] else ''}"
        f"{' + '.join(r['causes'])})"
        for r in list(runs.values())[-1]
        if r["outcome"] not in ("quiet", "named") and (r["tier"], r["outcome"]) != ("outside", "unknown")
    ]
    return (
        markdown(["figure", *runs], lines)
        + f"\n\nNot right by the last of these: {'; '.join(wrong) or 'none'}."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, help="what the folder was drawn with")
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--results", type=Path)
    parser.add_argument("--run")
    parser.add_argument("--cases", nargs="+")
    options = parser.parse_args(arguments)
    labels = json.loads((options.folder / "labels.json").read_text(encoding="utf-8"))
    if options.results is not None:
        _labs(options, [one for one in labels if (options.folder / one["case"] / "rig.toml").exists()])
        return
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


def _labs(options: argparse.Namespace, labels: Sequence[dict[str, Any]]) -> None:
    """Rows of one run over open labs, `cases` that are not there yet diagnosed first, and of the same cases
    what labels say of other code (`said_by_COMMIT`)."""
    options.results.mkdir(parents=True, exist_ok=True)
    runs: dict[str, list[dict[str, Any]]] = {}
    for label in labels:
        file = options.results / f"{label['case']}.json"
        if not file.exists() and (options.cases is None or label["case"] in options.cases):
            body = diagnose_folder(options.folder / label["case"])
            file.write_text(json.dumps(body) + "\n", encoding="utf-8")
        if not file.exists():
            continue
        for key in (k for k in label if k.startswith("said_by_")):
            said = label[key]
            body = (
                {"error": "", "seconds": 0.0}
                if said is None
                else {
                    **said,
                    "shrinkage": {"fraction": said["fraction"]},
                    "seconds": 0.0,
                }
            )
            runs.setdefault(key.removeprefix("said_by_"), []).append(row(label, body))
        runs.setdefault(options.run, []).append(row(label, json.loads(file.read_text(encoding="utf-8"))))
        one = runs[options.run][-1]
        print(*(one[k] for k in ("case", "effects", "outcome", "causes", "held_out")), flush=True)
    before = json.loads(LABS.read_text(encoding="utf-8"))["runs"] if LABS.exists() else {}
    save(LABS, {"runs": before | runs})


if __name__ == "__main__":
    main()
