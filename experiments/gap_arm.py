"""The diagnosis on recordings of a robot arm in a simulator of others: what is wrong, and what was done.

    python -m experiments.gap_arm ARM

ARM is a folder of sets, each with trials, task and a rig with its pads as measured (rig_pads.toml). The arm's
hand rolls while it carries in all of them but those called noroll. Default flags, four trials, blocks not
known. In view while the diagnosis was built. Writes experiments/results/gap_arm.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.gap_recordings import summary
from experiments.recordings import read_case
from experiments.saving import save
from experiments.table_text import load, markdown
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import read_rig

RESULT = Path(__file__).parent / "results" / "gap_arm.json"
# What was done to each set, and so what a fair answer is.
SETS = {
    "foam_restack_1": "nothing; the hand rolls",
    "foam_restack_1b": "nothing; the hand rolls",
    "foam_pick_4": "nothing; the hand rolls",
    "foam_restack_1_noroll": "nothing, roll taken out; friction creeps by some micrometres",
    "foam_restack_1_lowpass30": "low-pass of 30 ms; roll",
    "foam_restack_1_bias": "fx1 +0.10 N, fy2 -0.08 N; roll",
    "foam_restack_1_gain1_noroll": "forces of finger 1 times 1.1, roll taken out",
    "restack_1": "soft pads, a table that yields; roll",
    "pick_4": "soft pads, a table that yields; roll",
}


def table() -> str | None:
    """docs/gap_results.md: the sets of the arm."""
    found = load("gap_arm")
    if not isinstance(found, dict):
        return None
    rows = []
    for row in found["rows"]:
        told = " + ".join(row["causes"]) or row["verdict"]
        if row["partners"]:
            told += f" (or {', '.join(row['partners'])})"
        values = "; ".join(
            f"{k} {mean:.3g} {unit} ({low:.3g} to {high:.3g})"
            for k, (mean, low, high, unit) in row["parameters"].items()
        )
        rows.append([row["set"], SETS[row["set"]], told, values, f"{row['processor']:.0f} s"])
    return markdown(["set", "what was done", "found", "parameters (90 % interval)", "time"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("arm", type=Path)
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for name in SETS:
        folder = options.arm / name
        rig, case = read_rig(folder / "rig_pads.toml"), read_case(folder)
        trials = tuple(read_trial(Path(t.file), rig) for t in case.trials)
        case = replace(case, rig=rig, trials=trials, signals=tuple(task_space(t, rig) for t in trials))
        rows.append({"set": name, **summary(case, folder, measured=False)})
        print(name, rows[-1]["verdict"], rows[-1]["causes"], rows[-1]["partners"], flush=True)
        save(RESULT, {"rows": rows})


if __name__ == "__main__":
    main()
