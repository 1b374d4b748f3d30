"""Segmenting ever longer recordings of a repeated task: processor time and memory against their length.

    python -m experiments.benchmarks.long_recordings CASE

CASE holds rig.toml, task.toml and trial_01.csv, which is performed again and again. Each length is a process
of its own. Writes experiments/results/benchmark_long.json.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.saving import save
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment

OUT = Path(__file__).parents[1] / "results" / "benchmark_long.json"
ROUNDS = (1, 10, 100)


def measure(case: Path, rounds: int) -> dict:
    """One recording of so many rounds, segmented after one of a single round has loaded everything."""
    rig, task = Rig.read(case / "rig.toml"), Task.read(case / "task.toml")
    assert isinstance(task, BlockTask)
    task = replace(task, repeat="unknown")
    trial = Trial.read(case / "trial_01.csv", rig)
    segment([trial], task, rig)
    length = trial.t[-1] - trial.t[0] + float(np.median(np.diff(trial.t)))
    t = np.concatenate([trial.t + k * length for k in range(rounds)])
    channels = {name: np.tile(values, rounds) for name, values in trial.channels.items()}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    found = segment([Trial("long", t, channels)], task, rig)[0]
    return {
        "rows": t.size, "seconds": float(t[-1] - t[0]), "processor": time.process_time() - began,
        "memory_mb": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024,
        "rounds": rounds, "found": found.repetitions, "failed": len(found.failures),
    }  # fmt: skip


def main() -> None:
    """Measure every length, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("--rounds", type=int, help="this length alone, as JSON")
    args = parser.parse_args()
    if args.rounds is not None:
        print(json.dumps(measure(args.case, args.rounds)))
        return
    rows = []
    for rounds in ROUNDS:
        command = [sys.executable, "-m", "experiments.benchmarks.long_recordings", str(args.case)]
        done = subprocess.run([*command, "--rounds", str(rounds)], check=True, capture_output=True, text=True)
        rows.append(json.loads(done.stdout))
        print(rows[-1], flush=True)
    save(OUT, {"lengths": rows})


if __name__ == "__main__":
    main()
