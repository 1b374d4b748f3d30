"""How well trials that do not fit their task are found: every edit on every recording.

    python -m experiments.misfits RECORDINGS

Each recording is edited in each way of experiments.misfit_edits and judged alone, and pooled with
the unedited others of its case; unedited ones count false alarms. The constants of
hmmseg.segmentation.conformity were chosen with these recordings in view, so the same is done with
simulated trials of several tasks that were not. Writes experiments/results/misfits.json.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.misfit_edits import EDITS
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Move
from hmmseg.segmentation.conformity import MAX_RATE, Conformity, examine
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.features import features, thin
from simgap.world.properties import random_properties
from simgap.world.simulate import simulate_trials

RESULTS = Path(__file__).parent / "results"
POOLED = 4
NUM_SIMULATED, FIRST_SEED = 24, 1000
DISPLACED = ("force_lag_1",)  # forces come 0.25 s late, so that an edit by true times hits other contacts
TASKS = {
    "stack": BlockTask({"a": "b", "b": "ground"}, (Move("a", "ground"), Move("b", "a"))),
    "single": BlockTask({"a": "ground"}, (Move("a", "ground"),)),
    "slide": BlockTask({"a": "ground"}, (Move("a", "ground", True),)),
    "slide, then stack": BlockTask(
        {"a": "ground", "b": "ground"}, (Move("a", "ground", True), Move("b", "a"))
    ),
    "tower": BlockTask(
        {"a": "b", "b": "c", "c": "ground"}, (Move("a", "ground"), Move("b", "a"), Move("c", "b"))
    ),
}


def to_features(signals: Signals, rig: Rig) -> Features:
    """Features as `align` judges them."""
    return features(thin(signals, MAX_RATE), rig)


def on_edits(cases: Sequence[Case]) -> dict[str, dict]:
    """Per edit: shares detected and with the right subtask, alone and pooled; smallest log odds."""
    out = {}
    for name, edit in EDITS.items():
        alone, pooled, odds = [], [], []
        for case in cases:
            healthy = [to_features(s, case.rig) for s in case.signals[:POOLED]]
            for i, (trial, truth) in enumerate(zip(case.trials, case.truth, strict=True)):
                if truth is None:
                    continue
                edited, expected = edit(trial, truth)
                f = to_features(task_space(edited, case.rig), case.rig)
                (verdict,) = examine([f], [case.task])
                alone.append((verdict.failing is not None, verdict.failing == expected))
                if others := [h for j, h in enumerate(healthy) if j != i]:
                    among = examine([f, *others], [case.task] * (1 + len(others)))[0]
                    pooled.append((among.failing is not None, among.failing == expected))
                if verdict.wrong_rise is None:
                    odds.append(verdict.log_odds)
        out[name] = {
            "trials": len(alone), "alone": _shares(alone), "pooled": _shares(pooled),
            "least_log_odds": min(odds, default=None),
        }  # fmt: skip
    return out


def _shares(rows: list[tuple[bool, bool]]) -> dict[str, float] | None:
    if not rows:
        return None
    detected, right = np.mean(rows, axis=0)
    return {"detected": float(detected), "right_subtask": float(right)}


def on_recordings(cases: Sequence[Case]) -> dict:
    """False alarms on unedited recordings, alone and pooled by case, and the time of one verdict."""
    alone: list[Conformity] = []
    pooled: list[Conformity] = []
    seconds = []
    for case in cases:
        every = [to_features(s, case.rig) for s in case.signals]
        examine(every[:1], [case.task])  # compiles
        for f in every:
            start = time.perf_counter()
            alone += examine([f], [case.task])
            seconds.append(time.perf_counter() - start)
        pooled += examine(every, [case.task] * len(every))
    return {
        "trials": len(alone), "false_alarms": sum(v.failing is not None for v in alone),
        "false_alarms_pooled": sum(v.failing is not None for v in pooled),
        "largest_log_odds": max(v.log_odds for v in alone), "median_seconds": float(np.median(seconds)),
    }  # fmt: skip


def on_simulations(rig: Rig) -> dict[str, dict]:
    """False alarms on simulated trials of several tasks, each judged alone."""
    out = {}
    for name, task in TASKS.items():
        seeds = list(range(FIRST_SEED, FIRST_SEED + NUM_SIMULATED))
        simulated = simulate_trials(task, rig, [random_properties(task, s) for s in seeds], seeds)
        verdicts = [examine([to_features(task_space(s.trial, rig), rig)], [task])[0] for s in simulated]
        out[name] = {"trials": len(verdicts), "false_alarms": sum(v.failing is not None for v in verdicts)}
    return out


def simulated_cases(rig: Rig) -> list[Case]:
    """Simulated trials of the paper's task, every one a case with blocks of its own."""
    task, seeds = TASKS["stack"], range(FIRST_SEED, FIRST_SEED + NUM_SIMULATED)
    simulated = simulate_trials(task, rig, [random_properties(task, s) for s in seeds], seeds)
    return [
        Case(f"simulated_{s.seed}", rig, task, (s.trial,), (task_space(s.trial, rig),),
             (tuple(float(b) for b in s.boundaries),), {}, ("none",))
        for s in simulated
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    cases = [read_case(folder) for folder in list_cases(options.recordings)]
    document = {
        "recordings": on_recordings(cases),
        "simulated": on_simulations(cases[0].rig),
        "edits": on_edits([case for case in cases if case.name not in DISPLACED]),
        "edits_simulated": on_edits(simulated_cases(cases[0].rig)),
        "edits_displaced": on_edits([case for case in cases if case.name in DISPLACED]),
    }
    save(options.output / "misfits.json", document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
