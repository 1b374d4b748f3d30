"""Where the time of a command goes: stages of `segment` and whole commands, processor time, warm.

    python -m experiments.benchmarks.commands RECORDING_FOLDER

Writes experiments/results/benchmark_commands.json. Each figure is the least of five; every run is a
process of its own, so that imports count.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path

from experiments.saving import save

OUT = Path(__file__).parents[1] / "results" / "benchmark_commands.json"
REPEATS = 5
# Each program ends where its stage does; a stage is the difference to the one before.
STAGES = {
    "Python and the command line": "import hmmseg_cli.main",
    "reading task, rig and trial": (
        "from hmmseg.io.rig import Rig; from hmmseg.io.task import Task; from hmmseg.io.trial import Trial; "
        "rig = Rig.read('{rig}'); task = Task.read('{task}'); trial = Trial.read('{trial}', rig)"
    ),
    "loading the segmentation and its kernels": (
        "from hmmseg.segmentation import align as a; import hmmseg.hmm.kernels.dense, "
        "hmmseg.hmm.kernels.best_path, hmmseg.hmm.kernels.smoothing"
    ),
    "first segmentation (kernels from the disk)": "a.segment([trial], task, rig)",
    "one more segmentation": "a.segment([trial], task, rig)",
}


def processor(arguments: list[str]) -> float:
    """Processor time [s] of a process, user and system."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    files = {name: str(folder / f"{name}.toml") for name in ("rig", "task")}
    files["trial"] = str(sorted(folder.glob("trial_*.csv"))[0])
    programs, lines = [], []
    for line in STAGES.values():
        lines.append(line.format(**files))
        programs.append("\n".join(lines))
    totals = [min(processor(["-c", program]) for _ in range(REPEATS)) for program in programs]
    each = [b - a for a, b in zip([0.0, *totals], totals, strict=False)]
    # What one command does: all but the segmentation made once more.
    whole = sum(each[:-1])
    stages = {name: {"processor": s, "share": s / whole} for name, s in zip(STAGES, each, strict=True)}
    commands = {}
    for name in ("segment", "identify"):
        given = ["--task", files["task"], "--rig", files["rig"], "--quiet"]
        arguments = ["-m", "hmmseg_cli.main", name, files["trial"], *given]
        processor(arguments)
        commands[name] = {"warm": min(processor(arguments) for _ in range(REPEATS))}
    document = {"repeats": REPEATS, "stages": stages, "commands": commands}
    save(OUT, document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
