"""How long `hmmseg diagnose --model` takes for a minute of an arm of six joints, logged at 500 Hz.

    python -m experiments.benchmarks.robot MODELS [--seconds S]

MODELS as in experiments.robots_check. Two faults are planted; all candidates are considered. Writes
experiments/results/benchmark_robot.json: time and processor time of the whole command.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.benchmarks.commands import processor
from experiments.robots_check.faults import drawn
from experiments.robots_check.robots import ROBOTS, map_toml, nominal_xml
from experiments.robots_check.worlds import motion, noise_of, run, usual, world_of
from experiments.saving import save

OUT = Path(__file__).parents[1] / "results" / "benchmark_robot.json"
RATE = 500.0  # Hz
SEED = 11
FAULTS = ("friction", "armature")


def drawn_arm(models: Path, seconds: float, folder: Path) -> list[str]:
    """Write model, map and log; the faults in words."""
    arm = next(r for r in ROBOTS if r.name == "ur5e")
    rng = np.random.default_rng(SEED)
    xml = nominal_xml(arm, models, rng)
    sizes = usual(arm, xml)
    plain = world_of(xml, [], sizes)
    faults = [drawn(arm, plain, kind, rng) for kind in FAULTS]
    wanted = motion(arm, rng)
    shown = pd.DataFrame(run(replace(arm, seconds=seconds), world_of(xml, faults, sizes), wanted, rate=RATE))
    noise = noise_of(arm, xml)
    for joint, sd in noise.items():
        shown[f"q_{joint}"] += sd * rng.standard_normal(len(shown))
    shown.to_csv(folder / "log.csv", index=False, float_format="%.7g")
    (folder / "robot.xml").write_text(xml, encoding="utf-8")
    (folder / "map.toml").write_text(map_toml(arm, noise), encoding="utf-8")
    return [f"{f.kind} of {f.thing}" for f in faults]


def timed(folder: Path) -> dict[str, float]:
    """Time and processor time [s] of the command."""
    files = ["--model", str(folder / "robot.xml"), "--map", str(folder / "map.toml")]
    target = ["--json", str(folder / "found.json"), "--quiet"]
    began = time.perf_counter()
    busy = processor(["-m", "hmmseg_cli.main", "diagnose", str(folder / "log.csv"), *files, *target])
    return {"wall": round(time.perf_counter() - began, 1), "processor": round(busy, 1)}


def main() -> None:
    """Draw, time, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=OUT)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        faults = drawn_arm(given.models, given.seconds, folder)
        print(f"{given.seconds:g} s at {RATE:g} Hz: {', '.join(faults)}", flush=True)
        whole = timed(folder)
        found = json.loads((folder / "found.json").read_text(encoding="utf-8"))
        out: dict[str, Any] = {
            "seconds": given.seconds,
            "rate": RATE,
            "cores": os.cpu_count(),
            "load": [round(v, 1) for v in os.getloadavg()],
            "planted": faults,
            "whole": whole,
            "found": {k: found[k] for k in ("verdict", "causes", "indistinguishable")},
        }
    save(given.output, out)
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
