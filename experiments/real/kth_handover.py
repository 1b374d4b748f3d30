"""Handovers between people: lift-off and putting-down from forces alone, against the baton's height.

    python -m experiments.real.kth_handover FOLDER [--output FILE.json]

FOLDER holds the published recordings (Handovers@RPL, KTH; one folder each with Wrench_giver,
Wrench_taker, Wrench_interaction and baton_pose, 120 Hz). Nothing is labelled: the plain ordered task
below is learned from the five recordings themselves, the baton's pose is used only for the check.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.real.on_folder import run_on_folder
from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.segment import segment_sequence

RATE = 120.0  # Hz, nominal: the files have no time column
WRENCHES = {"giver": "Wrench_giver_saved.csv", "taker": "Wrench_taker_saved.csv",
            "load": "Wrench_interaction_saved.csv"}  # fmt: skip
POSE = "baton_pose_saved.csv"
# A clip may begin while the giver still lets go of the baton of the handover before. That some end in
# the next one needs no state: what follows the last event is learned apart.
TASK = SequenceTask(
    ("before", "rest", "grasp", "held by giver", "held by both", "held by taker", "put down", "rest"),
    ("giver", "taker", "load"),
    ("before",),
)  # fmt: skip
CLEARANCE = 0.01  # m above the level of rest: set on an edge first, the baton's middle is that high
STRICTER = 0.005  # m, reported beside it
RESULTS = Path(__file__).resolve().parents[1] / "results" / "kth_handover.json"


@dataclass(frozen=True)
class Handover:
    """Forces of one recording as a trial; `height` (num_timesteps,) of the baton [m]."""

    trial: Trial
    height: np.ndarray


def read_handover(folder: Path) -> Handover:
    """Grip of giver and taker [N] and the load between the halves, as shares of each one's own range.

    The masses differ between recordings, the shares do not. InputError for a malformed folder.
    """
    columns = {}
    for name, file in WRENCHES.items():
        columns[name] = _column(folder / file, "Fy" if name == "load" else "Fz")
    height = _column(folder / POSE, "z")
    grips = {name: -columns[name] for name in ("giver", "taker")}
    channels = {name: grip / np.quantile(grip, 0.95) for name, grip in grips.items()}
    channels["load"] = columns["load"] / np.quantile(np.abs(columns["load"]), 0.95)
    t = np.arange(height.size) / RATE
    return Handover(Trial(folder.name, t, channels), height)


def _column(path: Path, name: str) -> np.ndarray:
    try:
        frame = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"cannot be read ({error})", "a table with a header row") from None
    if name not in frame.columns:
        raise InputError(str(path), f"has no column {name}", f"columns {', '.join(frame.columns)}")
    return frame[name].to_numpy(dtype=float)


def height_events(t: np.ndarray, height: np.ndarray, clearance: float = CLEARANCE) -> tuple[float, float]:
    """Lift-off and putting-down [s]: when the baton leaves and reaches `clearance` [m] above its rest.

    Rest is the commonest height (to 1 mm) of the lower half before and after the highest point.
    """
    top = int(np.argmax(_first_flight(height)))
    before, after = height[:top], height[top:]
    lift = np.flatnonzero(before < _commonest(before) + clearance)[-1]
    down = np.flatnonzero(after < _commonest(after) + clearance)[0] + top
    return float(t[lift]), float(t[down])


def _first_flight(height: np.ndarray) -> np.ndarray:
    """Height without what follows the first landing: a clip may end inside the next handover."""
    level = (height.min() + height.max()) / 2
    above = np.flatnonzero(height > level)
    end = above[np.flatnonzero(np.diff(above) > 1)[:1]] if (np.diff(above) > 1).any() else above[-1:]
    return np.where(np.arange(height.size) <= end[0], height, -np.inf)


def _commonest(height: np.ndarray) -> float:
    low = height[height <= (height.min() + height.max()) / 2]
    cells, counts = np.unique(np.round(low, 3), return_counts=True)
    return float(cells[counts.argmax()])


def run(folder: Path) -> dict:
    """Lift-off and putting-down of every recording, from forces and from height."""
    handovers = [read_handover(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    results = segment_sequence([h.trial for h in handovers], TASK)
    rows = []
    for handover, result in zip(handovers, results, strict=True):
        start = {span.subtask: span for span in result.spans}
        lift, down = height_events(handover.trial.t, handover.height)
        strict = height_events(handover.trial.t, handover.height, STRICTER)
        rows.append({
            "recording": result.file, "complete": result.complete,
            "subtasks": [span.subtask for span in result.spans],
            "lift_off": {"force": start["held by giver"].start, "sd": start["held by giver"].start_sd,
                         "height": lift, "height_stricter": strict[0]},
            "put_down": {"force": start["put down"].start, "sd": start["put down"].start_sd,
                         "height": down, "height_stricter": strict[1]},
            "passed": [start["held by both"].start, start["held by taker"].start],
        })  # fmt: skip
    return {
        "format": "experiments.kth_handover/1",
        "clearance": CLEARANCE,
        "stricter": STRICTER,
        "recordings": rows,
    }


def table(document: dict) -> str:
    """The results for people."""
    lines = [f"{'':24}{'lift-off [s]':>26}{'putting-down [s]':>30}",
             f"{'':24}" + f"{'force':>8}{'height':>9}{'apart':>9}    " * 2]  # fmt: skip
    for row in document["recordings"]:
        cells = "".join(
            f"{row[e]['force']:8.3f}{row[e]['height']:9.3f}{row[e]['force'] - row[e]['height']:+9.3f}    "
            for e in ("lift_off", "put_down")
        )
        lines.append(f"{row['recording']:24}{cells}")
    return "\n".join(lines)


def main() -> None:
    """Run on a folder and write the results."""
    print(table(run_on_folder(__doc__, run, RESULTS)))


if __name__ == "__main__":
    main()
