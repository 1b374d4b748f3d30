"""How long `hmmseg identify` takes, whole process: import, compile, segment, sample, write.

    python -m experiments.benchmarks.identify [RECORDING] [--repeat 3]

On one trial and on four, first with an empty compilation cache (a first run ever), then with a warm
one. Wall-clock and processor time; a busy machine shows in the first, so the least of the repeats
counts. Writes experiments/results/benchmark_identify.json.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.saving import save

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parents[1] / "results"


def timed(recording: Path, trials: int, cache: Path) -> dict[str, float]:
    """Seconds of one whole process: `wall` and `processor`."""
    files = [str(f) for f in sorted(recording.glob("trial_*.csv"))[:trials]]
    described = ["--task", str(recording / "task.toml"), "--rig", str(recording / "rig.toml")]
    command = [
        sys.executable,
        "-m",
        "hmmseg_cli.main",
        "identify",
        *files,
        *described,
        "--json",
        "-",
        "--quiet",
    ]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"wall": wall, "processor": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, nargs="?", default=ROOT / "recordings" / "none_1")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args(arguments)
    document: dict = {"cores": os.cpu_count(), "recording": options.recording.name, "trials": {}}
    for trials in (1, 4):
        with tempfile.TemporaryDirectory() as folder:
            cold = timed(options.recording.resolve(), trials, Path(folder))
            warm = [timed(options.recording.resolve(), trials, Path(folder)) for _ in range(options.repeat)]
        least = {key: min(run[key] for run in warm) for key in ("wall", "processor")}
        document["trials"][str(trials)] = {"first": cold, "warm": least}
        print(f"{trials} trials: first {cold['wall']:.1f} s, warm {least['wall']:.1f} s "
              f"(processor {cold['processor']:.1f} and {least['processor']:.1f} s)", flush=True)  # fmt: skip
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / "benchmark_identify.json"
    save(path, document)


if __name__ == "__main__":
    main()
