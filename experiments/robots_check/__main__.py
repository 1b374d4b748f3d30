"""Seeded faults in robots modelled by others, diagnosed and scored.

    python -m experiments.robots_check MODELS --seed 1 --cases 24 --out DIR    # resumable: done cases stay
    python -m experiments.robots_check MODELS --seed 2 --cases 24 --robots reacher --out DIR
    python -m experiments.robots_check MODELS --score DIR                      # writes experiments/results

MODELS is a folder of unzipped wheels (`make robots-models` fetches them). Every case: a package's model with
masses and damping drawn at random; logs of the same robot at a third of the step by another integrator, with
its faults; the diagnosis sees the model and the logs alone. Kinds take turns: healthy, one fault, two, four,
none that is known.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.robots_check.faults import FAULTS, drawn
from experiments.robots_check.robots import ROBOTS, map_toml, nominal_xml
from experiments.robots_check.score import scored
from experiments.robots_check.worlds import LOGS, motion, nats, noise_of, run, usual, world_of
from experiments.saving import save

RESULTS = Path(__file__).resolve().parents[1] / "results" / "robots_check.json"
KINDS = ("single", "healthy", "pair", "single", "outside", "single", "dense", "healthy")
COUNT = {"healthy": 0, "single": 1, "pair": 2, "dense": 4, "outside": 1}
TURNS = ("ur5e", "manipulator", "pendulum", "reacher", "acrobot")


def case(number: int, seed: int, models: Path, turns: Sequence[str] = TURNS) -> dict:
    """One case: drawn, recorded, diagnosed."""
    from simgap.robots.describe import body
    from simgap.robots.diagnose import diagnose
    from simgap.simulators.mjcf.load import load_mjcf

    rng = np.random.default_rng([seed, number])
    robot = next(r for r in ROBOTS if r.name == turns[number % len(turns)])
    kind = KINDS[number % len(KINDS)]
    xml = nominal_xml(robot, models, rng)
    sizes, noise = usual(robot, xml), noise_of(robot, xml)
    known = [k for k, f in FAULTS.items() if f.outside == (kind == "outside")]
    chosen = rng.choice(known, COUNT[kind], replace=False)
    plain = world_of(xml, [], sizes)
    faults = [drawn(robot, plain, str(k), rng) for k in chosen]
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        paths, seen = [], np.zeros(len(faults))
        for log in range(LOGS):
            wanted = motion(robot, rng)
            seen += nats(robot, xml, faults, sizes, wanted, noise)
            shown = pd.DataFrame(run(robot, world_of(xml, faults, sizes), wanted))
            for joint, sd in noise.items():
                shown[f"q_{joint}"] += sd * rng.standard_normal(len(shown))
            paths.append(Path(folder) / f"log_{log}.csv")
            shown.to_csv(paths[-1], index=False, float_format="%.7g")
        (Path(folder) / "robot.xml").write_text(xml, encoding="utf-8")
        (Path(folder) / "map.toml").write_text(map_toml(robot, noise), encoding="utf-8")
        loaded = load_mjcf(Path(folder) / "robot.xml", Path(folder) / "map.toml")
        logs = [loaded.read(p) for p in paths]
        more = loaded.effects(logs)
        found = body(diagnose(loaded.simulator, logs, more=more, length=loaded.map.length))
    kept = ("verdict", "causes", "indistinguishable", "probabilities", "effects", "shrinkage", "detection")
    brief = {k: found[k] for k in kept} | {"remainder": found["remainder"]["share"]}
    return {
        "case": number,
        "robot": robot.name,
        "kind": kind,
        "faults": [vars(f) | {"nats": n} for f, n in zip(faults, seen.tolist(), strict=True)],
        "found": brief,
        "seconds": time.process_time() - began,
    }


def main() -> None:
    """Diagnose cases into a folder, or score a folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, default=24)
    parser.add_argument("--robots", nargs="+", default=TURNS, help="that take turns")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--score", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS)
    given = parser.parse_args()
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        for number in range(given.cases):
            path = given.out / f"{given.seed}_{number:04d}.json"
            if not path.exists():
                found = case(number, given.seed, given.models, given.robots)
                path.write_text(json.dumps(found, indent=1), encoding="utf-8")
                verdict = found["found"]["verdict"]
                print(number, found["robot"], [f["kind"] for f in found["faults"]], verdict, flush=True)
    if given.score is not None:
        every = [json.loads(p.read_text(encoding="utf-8")) for p in sorted(given.score.rglob("*.json"))]
        save(given.output, scored(every))


if __name__ == "__main__":
    main()
