"""Processor time of the stages of `segment` and `identify`, and of whole commands.

    python -m experiments.benchmarks.commands RECORDING_FOLDER

Writes experiments/results/benchmark_commands.json. Each figure is the least of three; every run is a
process of its own, so that imports count. The first run ever is one with an empty cache folder, where all
programs are compiled.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

from experiments.saving import save
from experiments.table_text import markdown, percent

OUT = Path(__file__).parents[1] / "results" / "benchmark_commands.json"
REPEATS = 3
# Each program ends where its stage does; a stage is the difference to the one before. The last is no part of
# a command: what the stage before would cost where all is loaded.
STAGES = {
    "Python and the command line": "import hmmseg_cli.main",
    "reading task, rig and trial": (
        "from hmmseg.io.rig import Rig; from hmmseg.io.task import Task; from hmmseg.io.trial import Trial; "
        "rig = Rig.read('{rig}'); task = Task.read('{task}'); trial = Trial.read('{trial}', rig)"
    ),
    "loading the segmentation and JAX": (
        "from hmmseg.segmentation import align as a; import hmmseg.hmm.dense, hmmseg.hmm.inference"
    ),
    "first segmentation (programs from the disk)": "a.segment([trial], task, rig)",
    "one more segmentation": "a.segment([trial], task, rig)",
}
IDENTIFY_STAGES = {
    "Python and the command line": STAGES["Python and the command line"],
    "reading task, rig and trial": STAGES["reading task, rig and trial"],
    "loading the segmentation, the estimation and JAX": (
        STAGES["loading the segmentation and JAX"] + "; import estimation.identification as e"
    ),
    "first segmentation (programs from the disk)": "found = a.align([trial], task, rig)",
    "properties": "e.identify_aligned(found)",
    "properties once more": "e.identify_aligned(found)",
}


def processor(arguments: list[str], cache: str | None = None) -> float:
    """Processor time [s] of a process, user and system; `cache`: another folder for what is compiled."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    env = os.environ | ({} if cache is None else {"XDG_CACHE_HOME": cache})
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=env)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def staged(stages: dict[str, str], files: dict[str, str]) -> dict[str, dict[str, float]]:
    """Processor time [s] of each stage, and its share of the whole except the last stage."""
    lines, totals = [], [0.0]
    for line in stages.values():
        lines.append(line.format(**files))
        totals.append(min(processor(["-c", "\n".join(lines)]) for _ in range(REPEATS)))
    each = [after - before for before, after in pairwise(totals)]
    return {name: {"processor": s, "share": s / totals[-2]} for name, s in zip(stages, each, strict=True)}


def table(found: dict) -> str:
    """docs/benchmarks.md: commands on one 10 s trial, by stage."""
    tables = [
        markdown(
            [f"stage of `{command}`", "processor", "share"],
            [[name, f"{1e3 * s['processor']:.0f} ms", percent(s["share"], 0)] for name, s in stages.items()],
        )
        for command, stages in found["stages"].items()
    ]
    note = "; ".join(
        f"`hmmseg {name}` {v['warm']:.1f} s warm, {v['first']:.0f} s the first time ever"
        for name, v in found["commands"].items()
    )
    return "\n\n".join([*tables, f"Whole commands, processor: {note}."])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    files = {name: str(folder / f"{name}.toml") for name in ("rig", "task")}
    files["trial"] = str(sorted(folder.glob("trial_*.csv"))[0])
    stages = {"segment": staged(STAGES, files), "identify": staged(IDENTIFY_STAGES, files)}
    commands = {}
    for name in stages:
        given = ["--task", files["task"], "--rig", files["rig"], "--quiet"]
        arguments = ["-m", "hmmseg_cli.main", name, files["trial"], *given]
        with tempfile.TemporaryDirectory() as empty:
            first = processor(arguments, cache=empty)
        processor(arguments)
        warm = min(processor(arguments) for _ in range(REPEATS))
        commands[name] = {"warm": warm, "first": first}
    document = {"repeats": REPEATS, "stages": stages, "commands": commands}
    save(OUT, document)
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
