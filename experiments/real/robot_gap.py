"""Real robots' logs against simulators of them: what the diagnosis says, as the docs tell it.

    python -m experiments.real.robot_gap KIND FOLDER [--output FILE.json]

KIND is xl330 or so101, FOLDER that of the logs (see experiments/real/xl330.py, so101.py).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.real.hiro_gap import rounded
from experiments.saving import save
from simgap.robots.describe import body
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.recording import read_recording
from simgap.simulators.user import load_simulator

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "results"
KINDS = {"xl330": ("xl330.py:Pendulum", "xl330_*.csv"), "so101": ("so101.py:Arm", "so101_*.csv")}
KEPT = (
    "verdict",
    "causes",
    "indistinguishable",
    "detection",
    "effects",
    "fitted",
    "discrepancy",
    "shrinkage",
    "identifiability",
    "next_experiment",
)


def summary(found: RobotDiagnosis) -> dict:
    """What the docs tell of a diagnosis."""
    told = body(found)
    likely = sorted(told["probabilities"].items(), key=lambda item: -item[1])[:8]
    out = {k: told[k] for k in KEPT} | {
        "probabilities": dict(likely),
        "remainder": told["remainder"]["share"],
    }
    if found.shrinkage is not None:
        out["by_fold"] = [list(names) for names in found.shrinkage.found]
        rows, far = found.composed.rows, found.shrinkage
        out["rms_by_log"] = (
            {
                log.name: [
                    float((r[rows.log == k] ** 2).mean() ** 0.5) for r in (found.plain.residual, far.residual)
                ]
                for k, log in enumerate(found.composed.recordings)
            }
            if len(rows.channels) == 1
            else {}
        )
    return rounded(out)


def run(kind: str, folder: Path) -> dict:
    """The diagnosis of a kind's logs."""
    spec, pattern = KINDS[kind]
    simulator = load_simulator(f"{HERE / spec}")
    logs = [read_recording(path, simulator.channels) for path in sorted(folder.glob(pattern))]
    return summary(diagnose(simulator, logs, tell=print))


def main() -> None:
    """Run on a folder and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    save(given.output or RESULTS / f"{given.kind}.json", run(given.kind, given.folder))


if __name__ == "__main__":
    main()
