"""An arm reaches, lowers and pushes a cube: where its hand goes, a plain Python simulator around the arm.

    python -m experiments.real.collins_push FOLDER --prepare DIR
    hmmseg diagnose DIR/*.csv --simulator experiments/real/collins_hand.py:Hand

Three targets follow each other. Where they were on the real arm nobody says, but for what the authors'
simulations were sent to: they are fitted along from there, by the trials that a fit sees. The cube is too
light to be felt.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.real import collins_arm as arm
from experiments.real.collins_arm import POSE
from simgap.robots.phases import Phases
from simgap.simulators.recording import Recording

MOVED = (1, 2, 3)  # joints; the others stay where they are
PHASES = ("reach", "lower", "push")
BEGINS = (0.0, 8.0, 14.0)  # s: when targets change
TARGETS = ((30.0, 120.0, 90.0), (-60.0, 65.0, 90.0), (-67.0, 30.0, 90.0))  # deg, of the authors' simulations
ASIDE = (1, 2)  # joints of which the real arm's targets are fitted along
LASTS = 20.0  # s
STEP = 0.005  # s of the solver: 0.3 mm from what 0.002 s give
LEFT = 0.01  # m: further than this a hand has left its place; markers are seen to jump by a few mm
RATE = 20.0  # Hz of the prepared logs


def _parameters() -> dict[str, dict[str, Any]]:
    # Where targets are fitted along, a joint's zero and ratio would be the targets' doing.
    out = arm.parameters(())
    for phase, angles in zip(PHASES, TARGETS, strict=True):
        for joint in ASIDE:
            at = angles[MOVED.index(joint)]
            out[f"{phase}.{joint + 1}"] = {"nominal": at, "sd": 5.0, "unit": "deg", "fitted": True}
    return out


class Hand:
    """The hand's pose `ee_*`; nothing is commanded but three targets, which every trial has alike."""

    channels = arm.CHANNELS
    parameters = _parameters()
    poses = {"ee": POSE}  # noqa: RUF012
    by_log = {  # noqa: RUF012
        "shift": {"nominal": 1.8, "sd": 0.4, "unit": "s"},
        "offset": {"nominal": 0.0, "sd": 0.005, "unit": "m"},
    }
    says = arm.SAYS

    def simulate(self, parameters, recording):
        """The pose at the recording's times."""
        return arm.seen(recording, *_course(tuple(parameters[n] for n in self.parameters)))


@lru_cache(maxsize=2048)
def _course(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and unit quaternions (n, 4) of the hand every SHOWN s, in the cameras' frame."""
    p = dict(zip(Hand.parameters, values, strict=True))
    targets = np.array(TARGETS)
    for k, phase in enumerate(PHASES):
        for joint in ASIDE:
            targets[k, MOVED.index(joint)] = p[f"{phase}.{joint + 1}"]
    targets = np.deg2rad(targets)

    def target(time: float) -> np.ndarray:
        return targets[np.searchsorted(BEGINS, time, side="right") - 1]

    angles = arm.driven(p, LASTS, MOVED, target, STEP)
    return arm.course(p, angles, MOVED)


def prepare(folder: Path, into: Path) -> list[Path]:
    """The real trials of a folder as logs of the hand."""
    return arm.prepared(folder / "cubepush" / "real", into, list(POSE.values()), RATE)


def phases(logs: Sequence[Recording]) -> Phases:
    """By when targets change, counted from when each trial's hand first leaves its place."""
    starts, number = [], np.arange(len(PHASES) + 1)
    for log in logs:
        began = left(log.t, np.array([log[POSE[a]] for a in "xyz"]))
        starts.append(np.array([log.t[0], *(began + np.array(BEGINS))]))
    return Phases(("before", *PHASES), tuple(starts), tuple(number for _ in logs))


def left(t: np.ndarray, place: np.ndarray) -> float:
    """When [s] of times t (n,) the hand, at `place` (3, n), left where it was."""
    return float(t[np.argmax(np.linalg.norm(place - place[:, :1], axis=0) > LEFT)])
