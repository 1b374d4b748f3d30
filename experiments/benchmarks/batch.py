"""A thousand trials from CSV to segments, each by itself, in processes of their own.

    python -m experiments.benchmarks.batch LAB [--trials N]

LAB is a folder with rig.toml and task.toml; its virtual model performs the task with seeds of its own.
Writes experiments/results/benchmark_batch.json: time and processor time of whole commands, and whether the
digits are the same with any number of workers.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.saving import save
from hmmseg_cli.main import main as hmmseg

OUT = Path(__file__).parents[1] / "results" / "benchmark_batch.json"
SEED = 2_200_000  # of trials that nothing else uses
A_FOLDER = 99  # trials that one call simulates
COMPARED = 24  # trials segmented with each number of workers, to compare digits


def simulated(lab: Path, number: int, place: Path) -> list[Path]:
    """So many trials of the lab's task."""
    given = ["--task", str(lab / "task.toml"), "--rig", str(lab / "rig.toml"), "--quiet"]
    paths: list[Path] = []
    for i in range((number + A_FOLDER - 1) // A_FOLDER):
        folder = place / f"{i:02d}"
        with contextlib.redirect_stdout(sys.stderr):
            assert hmmseg(["simulate", *given, "--trials", str(min(A_FOLDER, number - len(paths))),
                           "--seed", str(SEED + i), "--output", str(folder)]) == 0  # fmt: skip
        paths += sorted(folder.glob("trial_*.csv"))
    return paths


def segmented(paths: list[Path], lab: Path, workers: int, result: Path) -> dict[str, float]:
    """Time and processor time [s] of one command."""
    given = ["--task", str(lab / "task.toml"), "--rig", str(lab / "rig.toml"), "--quiet",
             "--workers", str(workers), "--json", str(result)]  # fmt: skip
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-m", "hmmseg_cli.main", "segment", *map(str, paths), *given], check=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"workers": workers, "wall": wall, "processor": processor}


def main() -> None:
    """Simulate, segment, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lab", type=Path)
    parser.add_argument("--trials", type=int, default=1000)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        paths = simulated(args.lab, args.trials, place)
        few = []
        for workers in (1, 2, 3):
            segmented(paths[:COMPARED], args.lab, workers, place / f"{workers}.json")
            few.append((place / f"{workers}.json").read_bytes())
        runs = [segmented(paths, args.lab, workers, place / "all.json") for workers in (2,)]
        found = json.loads((place / "all.json").read_text())["trials"]
    document = {
        "trials": len(found), "complete": sum(trial["complete"] for trial in found),
        "seconds_a_trial": 10.0, "cores": os.cpu_count(), "load": os.getloadavg()[0], "runs": runs,
        "compared": len(paths[:COMPARED]), "same_digits": len(set(few)) == 1,
    }  # fmt: skip
    save(OUT, document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
