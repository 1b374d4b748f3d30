"""Real robots' logs against simulators of them: what the diagnosis says, as the docs tell it.

    python -m experiments.real.robot_gap KIND FOLDER [--seconds S] [--output FILE.json] [--figures DIR]

KIND is xl330 or so101, FOLDER that of the logs (see experiments/real/xl330.py, so101.py). With --seconds, the
middle S s of every log are taken. Logs that name a gain (kp100) are held out gain by gain.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.real.hiro_gap import rounded
from experiments.saving import save
from hmmseg_cli.gap_figures import draw_before_after, draw_course
from simgap.report.robot import courses
from simgap.robots.describe import body
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.recording import Recording, read_recording
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
    out: dict[str, Any] = {k: told[k] for k in KEPT} | {
        "probabilities": dict(likely),
        "remainder": {n: told["remainder"][n] for n in ("share", "rms_over_noise")},
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
    done: Any = rounded(out)
    return done


def run(kind: str, folder: Path, only: Sequence[str] = (), seconds: float | None = None) -> RobotDiagnosis:
    """The diagnosis of a kind's logs, or of those of these names alone, or of their middle `seconds`."""
    spec, pattern = KINDS[kind]
    simulator = load_simulator(f"{HERE / spec}")
    paths = [p for p in sorted(folder.glob(pattern)) if not only or p.stem in only]
    logs = [middle(read_recording(p, simulator.channels), seconds) for p in paths]
    return diagnose(simulator, logs, tell=print, groups=gains_of([p.stem for p in paths]))


def gains_of(names: Sequence[str]) -> list[int] | None:
    """The gain that each log's name tells; None where some tell none."""
    found = [re.search(r"_kp(\d+)_", name) for name in names]
    return [int(g.group(1)) for g in found if g] if all(found) else None


def middle(log: Recording, seconds: float | None) -> Recording:
    """The middle `seconds` of a log; all of it by default."""
    if seconds is None:
        return log
    centre = 0.5 * float(log.t[0] + log.t[-1])
    first, last = np.searchsorted(log.t, [centre - 0.5 * seconds, centre + 0.5 * seconds])
    return log.window(int(first), int(last))


def published(found: RobotDiagnosis, name: str, output: Path | None, figures: Path | None) -> None:
    """Write the summary, and the figures NAME_signal.png and NAME_before_after.png where asked for."""
    save(output or RESULTS / f"{name}.json", summary(found))
    if figures is not None:
        widest = max(courses(found, {}), key=lambda c: c.over)
        draw_course(widest, found, figures / f"{name}_signal.png")
        draw_before_after(found, figures / f"{name}_before_after.png")


def asked(doc: str, kinds: Sequence[str] = ()) -> argparse.Namespace:
    """The command line: KIND where there are several, FOLDER, --output and --figures."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    if kinds:
        parser.add_argument("kind", choices=kinds)
        parser.add_argument("--seconds", type=float, help="of the middle of every log; all of it by default")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--figures", type=Path, help="folder that figures go to, such as docs/figures")
    parser.add_argument("--drawn", action="store_true", help="draw what was found before, where that serves")
    return parser.parse_args()


def main() -> None:
    """Run on a folder and write the results."""
    given = asked(__doc__ or "", sorted(KINDS))
    published(run(given.kind, given.folder, seconds=given.seconds), given.kind, given.output, given.figures)


if __name__ == "__main__":
    main()
