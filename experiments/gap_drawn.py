"""The diagnosis in open labs: false alarms, single effects, pairs, effects from outside, default flags.

    python -m experiments.gap_drawn FOLDER ... --results DIR --run NAME [--output FILE.json]

A FOLDER holds cases with labels.json next to them, as `python -m experiments.blind_check open` draws them.
Diagnoses go to DIR/FOLDER/CASE.json, so that a run may be resumed, its rows under NAME in FILE.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.blind_check.diagnose import diagnose_folder
from experiments.blind_check.judge import intervals_hold
from experiments.robots_check.score import FLOOR
from experiments.saving import save
from experiments.table_text import markdown
from simgap.attribution.verdict import RECORD

RESULT = Path(__file__).parent / "results" / "gap_labs.json"
SEEN = 0.01  # probability to act below which an effect is not listed
UNSEEN = ("missed", "too small")
WEAK = 0.3  # of the gap of held-out trials: causes that explain less are none, and more left is a remainder


def outcome(label: dict[str, Any], found: dict[str, Any]) -> str:
    """The outcome of a case: `quiet`, `false alarm`, `named`, `set`, `beside others`, `half` (of a pair),
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
    """Summary of a case's diagnosis; `gain` [nats] is that of the true effect alone."""
    gains = found.get("gains", {})
    return {
        "case": label["case"], "tier": label["tier"], "effects": label["effects"],
        "outcome": outcome(label, found), "verdict": found.get("verdict"), "causes": found.get("causes", []),
        "p_value": found.get("detection", {}).get("p_value"), "gain": gains.get(label["effects"][0]),
        "held_out": (found.get("shrinkage") or {}).get("fraction"),
        "probability": found.get("probabilities", {}).get("+".join(sorted(label["effects"])), 0.0),
        "seconds": round(found["seconds"], 1), "covered": covered(label, found),
        "confidence": confidence(found),
        "acting": [
            (round(one["probability"], 4), name in label["effects"])
            for name, one in found.get("attribution", {}).items() if one["probability"] >= SEEN
        ],
    }  # fmt: skip


def confidence(found: dict[str, Any]) -> float | None:
    """The probability of what a diagnosis says; None where it ended in an error."""
    if "error" in found:
        return None
    return found.get("probabilities", {}).get("+".join(found["causes"]) or found["verdict"])


def is_right(r: dict[str, Any]) -> bool:
    """Whether a verdict agrees with the label."""
    return r["outcome"] in ("quiet", "named") or (r["tier"], r["outcome"]) == ("outside", "unknown")


def reliability(rows: Sequence[dict[str, Any]], *verdicts: str) -> str:
    """Mean probability of what verdicts say, and how many are right."""
    of = [r for r in rows if r["verdict"] in verdicts and r.get("confidence") is not None]
    return _said([(r["confidence"], is_right(r)) for r in of])


def acted(rows: Sequence[dict[str, Any]], least: float, most: float) -> str:
    """Mean probability to act of effects with one from `least` to `most`, and how many do."""
    return _said([each for r in rows for each in r.get("acting", []) if least <= each[0] < most])


def _said(of: Sequence[tuple[float, bool]]) -> str:
    return f"{sum(p for p, _ in of) / len(of):.2f}; {sum(true for _, true in of)} of {len(of)}" if of else ""


def record(rows: Sequence[dict[str, Any]]) -> float:
    """Share of named sets and of their causes that are right over their mean probability without `RECORD`."""
    of = [r for r in rows if r["verdict"] in ("named", "set") and r["confidence"] is not None]
    each = [(is_right(r), r["confidence"]) for r in of] + [(act, p) for r in rows for p, act in r["acting"]]
    return RECORD * sum(right for right, _ in each) / max(sum(p for _, p in each), 1e-9)


def covered(label: dict[str, Any], found: dict[str, Any]) -> list[bool]:
    """Whether 90 % intervals of named effects hold what is true, of labels in the contract's parameters."""
    ours = {*label.get("params", {})} == {*label["effects"]} and found.get("verdict") in ("named", "set")
    return list(intervals_hold({**label, "effects": label["params"]}, found).values()) if ours else []


def table(found: dict[str, Any]) -> str:
    """docs/gap_results.md: open labs, one column a version of the code, or a set of labs."""
    runs: dict[str, list[dict[str, Any]]] = found["runs"]

    def line(name: str, tiers: Sequence[str], *which: str, least: float = float("-inf")) -> list[str]:
        cells = []
        for rows in runs.values():
            of = [r for r in rows if r["tier"] in tiers and (r["gain"] is None or r["gain"] >= least)]
            of = of if least < 0 or any(r["gain"] for r in of) else []  # older code, which said none
            cells.append(f"{sum(r['outcome'] in which for r in of)} of {len(of)}" if of else "")
        return [name, *cells]

    def weak(rows: Sequence[dict[str, Any]]) -> str:
        named = [r for r in rows if r["verdict"] in ("named", "set")]
        return f"{sum(r['held_out'] is not None and r['held_out'] < WEAK for r in named)} of {len(named)}"

    def open_left(rows: Sequence[dict[str, Any]]) -> str:
        of = [r for r in rows if r["tier"] == "outside"]
        right = (r["outcome"] == "unknown" or (r["causes"] and (r["held_out"] or 0.0) < 1 - WEAK) for r in of)
        return f"{sum(map(bool, right))} of {len(of)}" if of else ""

    def held(rows: Sequence[dict[str, Any]]) -> str:
        each = [one for r in rows for one in r.get("covered", [])]
        return f"{sum(each)} of {len(each)}" if each else ""

    lines = [
        line("healthy: none", ["healthy"], "quiet"),
        line("single: named alone", ["single"], "named"),
        line("single: in a set", ["single"], "set"),
        line("single: named with others", ["single"], "beside others"),
        line("single: unknown", ["single"], "unknown"),
        line("single: not noticed, or too small to matter", ["single"], *UNSEEN),
        line("single: another name", ["single"], "wrong name"),
        line(f"single that gains {FLOOR:.0f} nats: named alone", ["single"], "named", least=FLOOR),
        line("the same: named alone or in a set", ["single"], "named", "set", least=FLOOR),
        line("pairs: whole", ["pair"], "named"),
        line("pairs: one of both", ["pair"], "half"),
        line("outside: unknown", ["outside"], "unknown"),
        ["outside: unknown, or over 30 % left", *(open_left(rows) for rows in runs.values())],
        ["named with a held-out share below 0.3", *(weak(rows) for rows in runs.values())],
        ["what is named: mean probability; right", *(reliability(r, "named", "set") for r in runs.values())],
        ["none: mean probability; right", *(reliability(r, "none") for r in runs.values())],
        ["effects likely to act: mean probability; act", *(acted(r, 0.5, 1.1) for r in runs.values())],
        ["effects less likely to act", *(acted(r, 0.0, 0.5) for r in runs.values())],
        ["90 % intervals that hold the parameter", *(held(rows) for rows in runs.values())],
        ["seconds of processor, median",
         *(str(round(sorted(r["seconds"] for r in rows)[len(rows) // 2]) or "") for rows in runs.values())],
    ]  # fmt: skip
    of = [r for r in list(runs.values())[-1] if not is_right(r) and r["outcome"] not in UNSEEN]
    said = (": ".join(filter(None, (r["outcome"], "+".join(r["causes"])))) for r in of)
    wrong = [f"{r['case']} {'+'.join(r['effects'])} ({what})" for r, what in zip(of, said, strict=True)]
    shown = markdown(["figure", *runs], [each for each in lines if any(each[1:])]) + "\n\n"
    return f"{shown}Neither right nor unseen by the last of these: {'; '.join(wrong) or 'none'}."


def main(arguments: Sequence[str] | None = None) -> None:
    """Rows of one run over open labs, and what labels say of other code (`said_by_COMMIT`)."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--run", required=True)
    parser.add_argument("--output", type=Path, default=RESULT)
    options = parser.parse_args(arguments)
    cases: list[tuple[Path, dict[str, Any]]] = []
    for folder in options.folders:
        (options.results / folder.name).mkdir(parents=True, exist_ok=True)
        labels = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
        cases += [(folder, label) for label in labels]
    runs: dict[str, list[dict[str, Any]]] = {}
    for folder, label in cases:
        case, file = folder / label["case"], options.results / folder.name / f"{label['case']}.json"
        if not (case / "rig.toml").exists():
            continue
        if not file.exists():
            file.write_text(json.dumps(diagnose_folder(case)) + "\n", encoding="utf-8")
        for key in (k for k in label if k.startswith("said_by_")):
            body = {"error": "", "seconds": 0.0}
            if (said := label[key]) is not None:
                body = {**said, "shrinkage": {"fraction": said["fraction"]}, "seconds": 0.0}
            runs.setdefault(key.removeprefix("said_by_"), []).append(row(label, body))
        one = row(label, json.loads(file.read_text(encoding="utf-8")))
        runs.setdefault(options.run, []).append(one)
        print(*(one[k] for k in ("case", "effects", "outcome", "causes", "held_out")), flush=True)
    print(f"record of what is named: {record(runs[options.run]):.2f}")
    old = json.loads(options.output.read_text(encoding="utf-8")) if options.output.exists() else {"runs": {}}
    save(options.output, {"runs": old["runs"] | runs})


if __name__ == "__main__":
    main()
