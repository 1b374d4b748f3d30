"""An arm moves two joints out and back twice: a plain Python simulator around its authors' MuJoCo model.

    python -m experiments.real.collins FOLDER              # writes experiments/results/collins_twojoint.json
    python -m experiments.real.collins FOLDER --prepare DIR
    hmmseg diagnose DIR/*.csv --simulator experiments/real/collins.py:TwoJoint

FOLDER holds twojoint/real/real_*.csv (Collins, Howard, Leitner: a Kinova Mico2, its hand's pose seen by
cameras). The authors' controller is P on every joint at 20 Hz with a limit of speed, into velocity servos;
their simulated trial is met to 0.5 mm. Every real trial was started by hand, and markers were moved between
sessions, so each log has a shift in time and an offset of the marker of its own.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.real import collins_arm as arm
from experiments.real.collins_arm import POSE

HERE = Path(__file__).resolve().parent
MOVED = (1, 4)  # joints
TARGETS = np.deg2rad([(-90.0, -90.0), (0.0, 0.0), (-90.0, 90.0), (0.0, 0.0)])
EVERY = 5.0  # s between targets
LASTS = 24.0  # s
RATE = 20.0  # Hz of the prepared logs


class TwoJoint:
    """The hand's pose `ee_*`; nothing is commanded but the four targets, which every trial has alike."""

    channels = arm.CHANNELS
    parameters = arm.parameters(MOVED)
    poses = {"ee": POSE}  # noqa: RUF012
    by_log = {  # noqa: RUF012
        "shift": {"nominal": 1.2, "sd": 0.3, "unit": "s"},
        "offset": {"nominal": 0.0, "sd": 0.005, "unit": "m"},
    }
    says = arm.SAYS

    def simulate(self, parameters, recording):
        """The pose at the recording's times."""
        return arm.seen(recording, *_course(tuple(parameters[n] for n in self.parameters)))


@lru_cache(maxsize=256)
def _course(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and unit quaternions (n, 4) of the hand every SHOWN s, in the cameras' frame."""
    p = dict(zip(TwoJoint.parameters, values, strict=True))
    angles = arm.driven(p, LASTS, MOVED, lambda t: TARGETS[min(int(t / EVERY), len(TARGETS) - 1)])
    return arm.course(p, angles, MOVED)


def prepare(folder: Path, into: Path) -> list[Path]:
    """The real trials as logs."""
    return arm.prepared(folder / "twojoint" / "real", into, list(POSE.values()), RATE)


def main() -> None:
    """Prepare and diagnose the real trials, and write the results."""
    import tempfile

    from experiments.real.robot_gap import RESULTS, summary
    from experiments.saving import save
    from simgap.robots.diagnose import diagnose
    from simgap.simulators.recording import read_recording
    from simgap.simulators.user import load_simulator

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--prepare", type=Path, metavar="DIR", help="write the prepared logs and stop")
    parser.add_argument("--output", type=Path, default=RESULTS / "collins_twojoint.json")
    given = parser.parse_args()
    if given.prepare is not None:
        given.prepare.mkdir(parents=True, exist_ok=True)
        prepare(given.folder, given.prepare)
        return
    simulator = load_simulator(f"{HERE / 'collins.py'}:TwoJoint")
    with tempfile.TemporaryDirectory() as into:
        logs = [read_recording(p, simulator.channels) for p in prepare(given.folder, Path(into))]
    save(given.output, summary(diagnose(simulator, logs, tell=print)))


if __name__ == "__main__":
    main()
