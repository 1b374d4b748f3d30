"""Are trials that do not fit their task found in worlds that differ, and healthy ones left alone?

    python -m experiments.misfit_worlds [--rows NAME...] [--healthy 100] [--edited 20]

The worlds are those of experiments/calibration_worlds.py in which one trial of two blocks is recorded, with
seeds of their own; edits are those of experiments/misfit_edits.py. Writes
experiments/results/misfit_worlds.json, which docs/calibration.md shows.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from experiments import calibration_worlds
from experiments.calibration_worlds import ROWS, replicates
from experiments.misfit_edits import EDITS
from experiments.saving import save
from experiments.world_scores import Replicate
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment

RESULTS = Path(__file__).parent / "results" / "misfit_worlds.json"
FIRST, HEALTHY, EDITED = 110_000, 100, 20  # seeds that nothing was chosen on
SHOWN = ("drop_first_go_on", "drop_second", "drop_and_retry", "regrasp", "no_second_move")
WORLDS = [name for name, row in ROWS.items() if row.blocks == 2 and row.trials == 1]


def judged(trial: Trial, of: Replicate) -> int | None:
    """Index of the subtask at which a trial fails, None where it fits."""
    (found,) = segment([trial], of.task, of.rig)
    return None if found.failed is None else found.failed.index


def row(name: str, healthy: int, edited: int) -> dict:
    """False alarms of one world, and by edit how many were found, and found at the right subtask."""
    every = list(replicates(ROWS[name], healthy))
    out: dict = {"trials": healthy, "alarms": sum(judged(r.trials[0], r) is not None for r in every)}
    for edit in SHOWN:
        found = []
        for r in every[:edited]:
            trial, expected = EDITS[edit](r.trials[0], list(r.boundaries[0]))
            at = judged(trial, r)
            found.append((at is not None, at == expected))
        out[edit] = {"trials": edited, "found": sum(f for f, _ in found), "right": sum(r for _, r in found)}
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="*", default=WORLDS, metavar="NAME")
    parser.add_argument("--healthy", type=int, default=HEALTHY)
    parser.add_argument("--edited", type=int, default=EDITED)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    calibration_worlds.FIRST = FIRST
    rows = {}
    for name in options.rows:  # worlds of one pace and hand share their performances
        rows[name] = row(name, options.healthy, options.edited)
        print(name, rows[name], flush=True)
    save(options.output, {"first": FIRST, "rows": rows})


if __name__ == "__main__":
    main()
