"""What was reported of earlier code on tasks, rates and hands other than the usual, and what holds now.

    python -m experiments.then_and_now RECORDINGS

Identifies the cases of a folder of recordings that reports were about (towers of three, 1 kHz, trials that do
not fit); the other figures are those of tables that other experiments fill. Writes
experiments/results/then_and_now.json; docs/calibration.md shows both.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.recordings import list_cases, read_case
from experiments.saving import save
from experiments.table_text import RESULTS, load, markdown, percent

OUT = RESULTS / "then_and_now.json"
GROUPS = {"towers": ("tower3",), "1 kHz": ("fast1k",), "misfits": ("drop", "regrasp", "missing_move")}


def measure(folder: Path) -> dict[str, Any]:
    """Errors, z and ranks of each property by group of cases; how many trials are said not to fit."""
    from estimation import identify

    out: dict[str, Any] = {}
    for group, kinds in GROUPS.items():
        rows, failed, trials = [], 0, 0
        for path in list_cases(folder):
            if path.name.rpartition("_")[0] not in kinds:
                continue
            case = read_case(path)
            found = identify(list(case.trials), case.task, case.rig)
            trials += len(case.trials)
            failed += sum(not s.complete for s in found.segmentations)
            for obj, prop in found.names if group != "misfits" else ():
                true, draws = case.blocks[obj][prop][0], found.of(obj, prop)
                rows.append({
                    "property": prop, "share": float(draws.mean() / true - 1),
                    "inside": bool(abs((draws < true).mean() - 0.5) < 0.475),
                })  # fmt: skip
        out[group] = {"trials": trials, "failed": failed, "rows": rows}
    return out


def _inside(group: dict[str, Any], prop: str) -> str:
    rows = [r for r in group["rows"] if r["property"] == prop]
    rms = np.sqrt(np.mean([r["share"] ** 2 for r in rows]))
    return f"{percent(rms, 3)} rms, {sum(r['inside'] for r in rows)} of {len(rows)} inside 95 %"


def table() -> str | None:
    """Reported of earlier code, and now."""
    own, labs, worlds, misfits = (
        load(name) for name in ("then_and_now", "identified", "calibration_boundaries", "misfit_worlds")
    )
    plain = load("sequences")
    if own is None or labs is None or worlds is None or misfits is None or plain is None:
        return None
    cover = {name: row["all"]["coverage_90"] for name, row in worlds["rows"].items()}
    untold = [v for name, v in cover.items() if name.startswith("untold")]
    faster = [cover[f"{rate} Hz"] for rate in ("50", "100", "1000")]
    arm, pads = (labs[f"panda, unlabelled, {rig}, all trials"] for rig in ("rig", "rig_pads"))
    alarms = {name: f"{misfits['rows'][name]['alarms']} of {misfits['rows'][name]['trials']}"
              for name in ("noise x16", "ringing 1 N")}  # fmt: skip
    guarded, wrist = (plain["groups"][name]["none"] for name in ("snap assemblies", "arm's wrist"))
    towers, fast = own["towers"], own["1 kHz"]
    rows = [
        ["towers of three reversed: weights", "wrong by factors of 4 to 160", _inside(towers, "weight")],
        ["1 kHz: widths", "0.01 to 0.02 % off, 0 of 4 inside 95 %", _inside(fast, "width")],
        ["1 kHz: heights", "2 of 4 inside 95 %", _inside(fast, "height")],
        ["90 % boundary intervals at 10 Hz; at 50 to 1,000 Hz", "83 to 89 %",
         f"{percent(cover['10 Hz'], 0)}; {percent(min(faster), 0)} to {percent(max(faster), 0)}"],
        ["at three times the pace; contacts that ring by 1 N", "75; 61 %",
         f"{percent(cover['pace 3'], 0)}; {percent(cover['ringing 1 N'], 0)}"],
        ["with an effect that identify is not told of", "71 %",
         f"{percent(float(np.mean(untold)), 0)} ({percent(min(untold), 0)} to {percent(max(untold), 0)})"],
        ["robot arm: weights (now with untold gain and bias among them)", "0.2 % rms, 8 of 8 inside 95 %",
         _of(arm, "weight")],
        ["robot arm: widths, pads as known (likewise)", "2 of 8 inside 95 %", _of(pads, "width")],
        ["robot arm: 90 % boundary intervals", "34 to 56 %", percent(arm["boundaries"]["coverage_90"], 0)],
        ["drops, regrasps and missing moves said not to fit", "12 of 12",
         f"{own['misfits']['failed']} of {own['misfits']['trials']}"],
        ["healthy trials rejected: noise x16; ringing 1 N", "6 %; 4 of 64",
         f"{alarms['noise x16']}; {alarms['ringing 1 N']}"],
        ["snap assemblies without labels", "the last boundary 1.5 s off in all, nothing said",
         f"{percent(guarded['listed'], 0)} at a place that is told, asked for a label; "
         f"intervals hold {percent(guarded['coverage_90'], 0)}"],
        ["arm's wrist without labels", "1.45 s off in the median, nothing said",
         f"{percent(wrist['listed'], 0)} at a place that is told; "
         f"{percent(wrist['median'], 1)} of the trial off in the median"],
    ]  # fmt: skip
    note = (f"Now: recordings of towers, 1 kHz and misfits by commit {own['made_by']}, the arm's by "
            f"{labs['made_by']}, boundaries by {worlds['made_by']}, rejections by {misfits['made_by']}, "
            f"sequences by {plain['made_by']}.")  # fmt: skip
    return f"{markdown(['', 'reported of earlier code', 'now'], rows)}\n\n{note}"


def _of(entry: dict[str, Any], prop: str) -> str:
    p = entry[prop]
    return f"{percent(p['rms'], 2)} rms, {round(p['coverage_95'] * p['count'])} of {p['count']} inside 95 %"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, help="folder with towers, 1 kHz and misfits")
    options = parser.parse_args(arguments)
    save(OUT, measure(options.recordings))


if __name__ == "__main__":
    main()
