"""Diagnosis of a real servo's logs against a simulator of it, as published in the docs.

    python -m experiments.real.robot_gap FOLDER [--output FILE.json] [--figures DIR]

FOLDER is that of the logs (see experiments/real/xl330.py). Logs that name a gain (kp100) are held out gain by
gain.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.golden import rounded
from experiments.saving import save
from simgap.report.figures import draw_before_after, draw_course
from simgap.report.robot import courses
from simgap.robots.describe import body
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.recording import read_recording
from simgap.simulators.user import load_simulator

HERE = Path(__file__).resolve().parent
RESULT = HERE.parent / "results" / "xl330.json"
SIMULATOR, LOGS = "xl330.py:Pendulum", "xl330_*.csv"
KEPT = ("verdict", "causes", "indistinguishable", "detection", "effects", "fitted", "discrepancy",
        "shrinkage", "identifiability", "next_experiment")  # fmt: skip


def summary(found: RobotDiagnosis) -> dict:
    """The parts of a diagnosis that the docs publish."""
    document = body(found)
    likely = sorted(document["probabilities"].items(), key=lambda item: -item[1])[:8]
    out: dict[str, Any] = {k: document[k] for k in KEPT} | {
        "probabilities": dict(likely),
        "remainder": {n: document["remainder"][n] for n in ("share", "rms_over_noise")},
    }
    if found.shrinkage is not None:
        rows, far = found.composed.rows, found.shrinkage
        if len(rows.channels) == 1:
            names = [log.name for log in found.composed.recordings]
            both = (far.plain, far.residual)

            def rms(mine: np.ndarray) -> list[float]:
                return [float(np.mean(r[mine] ** 2) ** 0.5) for r in both]

            out["rms_by_log"] = {name: rms(rows.log == k) for k, name in enumerate(names)}
            gains = gains_of(names)
            for gain in sorted(set(gains or ())):
                mine = np.isin(rows.log, np.flatnonzero(np.array(gains) == gain))
                out.setdefault("rms_by_gain", {})[str(gain)] = rms(mine)
    return rounded(out, 5)


def run(folder: Path, only: Sequence[str] = ()) -> RobotDiagnosis:
    """The diagnosis of a folder's logs, or of those of these names alone."""
    simulator = load_simulator(f"{HERE / SIMULATOR}")
    paths = [p for p in sorted(folder.glob(LOGS)) if not only or p.stem in only]
    logs = [read_recording(p, simulator.channels) for p in paths]
    return diagnose(simulator, logs, tell=print, groups=gains_of([p.stem for p in paths]))


def gains_of(names: Sequence[str]) -> list[int] | None:
    """The gain in each log's name; None if some names have none."""
    found = [re.search(r"_kp(\d+)_", name) for name in names]
    return [int(g.group(1)) for g in found if g] if all(found) else None


def main() -> None:
    """Run on a folder and write the summary, and with --figures both figures of the docs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path, default=RESULT)
    parser.add_argument("--figures", type=Path, help="folder that figures go to, such as docs/figures")
    given = parser.parse_args()
    found = run(given.folder)
    save(given.output, summary(found))
    if given.figures is not None:
        widest = max(courses(found, {}), key=lambda c: c.over)
        draw_course(widest, found, given.figures / "xl330_signal.png")
        draw_before_after(found, given.figures / "xl330_before_after.png")


if __name__ == "__main__":
    main()
