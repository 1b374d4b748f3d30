"""Segmenting ever longer recordings of a repeated task from disk: time and peak memory against their length.

    python -m experiments.benchmarks.long_recordings LAB

LAB holds rig.toml and task.toml; its virtual model performs the task once at 1 kHz, and this round is
repeated. Each length and kind of file is written piece by piece and segmented in a separate process, whose
peak memory includes Python and all libraries; where memory allows, the same is done in one piece and the
answers compared. Writes experiments/results/benchmark_long.json.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.saving import save
from experiments.table_text import markdown
from hmmseg.hand.read import LongRecording
from hmmseg.io.formats import kind_of, rows_of
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment, segment_long

OUT = Path(__file__).parents[1] / "results" / "benchmark_long.json"
RATE = 1000.0  # Hz
SEED = 2_300_000  # of a round that nothing else uses
ROUNDS = (1, 10, 100, 360, 1000)  # an hour of 10 s rounds among them
SAME = 1e-9  # numerics: s; what the order of sums may change from process to process
KINDS = (".parquet", ".npz")
IN_MEMORY = 100  # numerics: rounds up to which the same is done in one piece


def simulated(lab: Path, case: Path) -> None:
    """The lab's task performed once at RATE into a folder: rig.toml, task.toml and trial_01.csv."""
    faster, found = re.subn(r"(?m)^rate *=.*", f"rate = {RATE}", (lab / "rig.toml").read_text())
    assert found == 1, "rig.toml states one rate"
    rig = case.parent / "rig_faster.toml"
    rig.write_text(faster)
    given = ["--task", str(lab / "task.toml"), "--rig", str(rig), "--seed", str(SEED), "--output", str(case)]
    # In a separate process: the measured ones inherit the peak memory of this one.
    subprocess.run([sys.executable, "-m", "hmmseg_cli.main", "simulate", *given, "--quiet"], check=True)


def performed(case: Path) -> tuple[BlockTask, Rig]:
    """The case's task, repeated as often as recorded, and its rig."""
    task = Task.read(case / "task.toml")
    assert isinstance(task, BlockTask)
    return replace(task, repeat="unknown"), Rig.read(case / "rig.toml")


def rounds_of(case: Path, rig: Rig, rounds: int) -> Iterator[dict[str, np.ndarray]]:
    """Columns of each round in turn."""
    trial = Trial.read(case / "trial_01.csv", rig)
    length = trial.t[-1] - trial.t[0] + float(np.median(np.diff(trial.t)))
    for k in range(rounds):
        yield {"t": trial.t + k * length} | trial.channels


def write(case: Path, rig: Rig, rounds: int, path: Path) -> None:
    """Write a recording of a number of rounds as Parquet or NPZ."""
    if path.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pieces = rounds_of(case, rig, rounds)
        first = pa.table(next(pieces))
        with pq.ParquetWriter(path, first.schema) as file:
            file.write_table(first)
            for columns in pieces:
                file.write_table(pa.table(columns))
        return
    names = list(next(rounds_of(case, rig, 1)))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name in names:  # a column at a time, as numpy.savez has them
            column = np.concatenate([columns[name] for columns in rounds_of(case, rig, rounds)])
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, column)


def measure(case: Path, path: Path, in_memory: bool) -> dict:
    """One recording segmented; what was found, time and peak memory of this process."""
    task, rig = performed(case)
    began, worked = time.perf_counter(), time.process_time()
    if in_memory:
        found = segment([Trial.read(path, rig)], task, rig)[0]
    else:
        found = segment_long(LongRecording(path, rig), task, rig)
    return {
        "wall": time.perf_counter() - began, "processor": time.process_time() - worked,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "found": found.repetitions, "failed": len(found.failures),
        "answer": [span.start for span in found.spans],
    }  # fmt: skip


def table(found: dict) -> str:
    """docs/benchmarks.md: long recordings."""
    rows = [
        [f"{row['rows']:,}", row["from"], f"{row['found']} of {row['rounds']}", f"{row['processor']:.1f} s",
         f"{row['memory_mb']:.0f} MB", {True: "yes", False: "NO", None: ""}[row.get("same_answer")]]
        for row in found["lengths"]
    ]  # fmt: skip
    head = ["rows", "read from", "rounds found", "processor", "peak memory", "as in one piece"]
    return markdown(head, rows)


def main() -> None:
    """Measure every length, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lab", type=Path, help="with --file: the folder of the round")
    parser.add_argument("--file", type=Path, help="measure this recording alone, as JSON")
    parser.add_argument("--in-memory", action="store_true")
    parser.add_argument("--rounds", type=int, nargs="+", default=ROUNDS)
    parser.add_argument("--kinds", nargs="+", default=KINDS, help="of files; what is not measured stays")
    args = parser.parse_args()
    if args.file is not None:
        print(json.dumps(measure(args.lab, args.file, args.in_memory)))
        return
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "round"
        simulated(args.lab, case)
        _, rig = performed(case)
        for rounds in args.rounds:
            for kind in args.kinds:
                path = Path(folder) / f"long{kind}"
                write(case, rig, rounds, path)
                row = _row(case, path, rounds, False)
                if rounds <= IN_MEMORY and kind == ".parquet":
                    whole = _row(case, path, rounds, True)
                    row["same_answer"] = bool(
                        np.allclose(whole.pop("answer"), row["answer"], rtol=0, atol=SAME)
                    )
                    rows.append(whole)
                    print(whole, flush=True)
                del row["answer"]
                rows.append(row)
                print(row, flush=True)
                path.unlink()
    measured = {(row["rows"], row["from"]): row for row in rows}
    kept = json.loads(OUT.read_text())["lengths"] if OUT.exists() else []
    merged = {(row["rows"], row["from"]): row for row in kept} | measured
    save(OUT, {"lengths": [merged[key] for key in sorted(merged, key=lambda key: key[0])]})


def _row(case: Path, path: Path, rounds: int, in_memory: bool) -> dict:
    command = [sys.executable, "-m", "experiments.benchmarks.long_recordings", str(case), "--file", str(path)]
    done = subprocess.run(command + ["--in-memory"] * in_memory, check=True, capture_output=True, text=True)
    count = rows_of(path, kind_of(path))
    kind = "in one piece" if in_memory else {".parquet": "Parquet", ".npz": "NPZ"}[path.suffix]
    load = {"load": os.getloadavg()[0], "cores": os.cpu_count()}
    return {"rows": count, "rounds": rounds, "from": kind} | load | json.loads(done.stdout)


if __name__ == "__main__":
    main()
