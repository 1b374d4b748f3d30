"""Real trials of an arm against real trials of it: no gap may be found.

    python -m experiments.real.collins_alike FOLDER [--output FILE.json]

The trials (see experiments/real/collins.py) are split in two at random SPLITS times, and one half is
diagnosed against the other as an ensemble (`hmmseg diagnose --against`). Every trial was started by hand and
markers were moved between sessions: before that, each trial's shift in time and its marker's offset, fixed in
the hand's frame and in the room's, are fitted to the mean of all, whichever half it will be in.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from experiments.real.collins import EVERY, POSE, RATE, prepare
from experiments.real.on_folder import run_on_folder
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from simgap.generic.aligned import align
from simgap.generic.diagnose import detect
from simgap.robot_effects.readout_pose import rotated

RESULTS = Path(__file__).resolve().parents[1] / "results" / "collins_alike.json"
SPLITS = 20  # cited: how many the task asks for
PLACE, TURN = [POSE[a] for a in "xyz"], [POSE[a] for a in ("qw", "qx", "qy", "qz")]
MOVES = ("out", "back", "out again", "back again")
MARGIN = 1.0  # s: more than any trial's shift


def aligned(frames: list[pd.DataFrame]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Places (n, 3) of every trial on common times (n,), shift and offsets taken out; and the shifts."""
    ends = min(f.t.iloc[-1] for f in frames)
    times = np.arange(frames[0].t.iloc[0] + MARGIN, ends - MARGIN, 1 / RATE)
    shifts, out = np.zeros(len(frames)), [_at(f, times)[0] for f in frames]
    for _ in range(12):
        mean = np.mean(out, 0)
        for k, frame in enumerate(frames):
            x = least_squares(_off, np.r_[shifts[k], np.zeros(6)], args=(frame, times, mean)).x
            shifts[k], out[k] = x[0], mean - _off(x, frame, times, mean).reshape(-1, 3)
    return out, times, shifts


def _at(frame: pd.DataFrame, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    read = [np.array([np.interp(times, frame.t, frame[c]) for c in names]) for names in (PLACE, TURN)]
    return read[0].T, read[1] / np.linalg.norm(read[1], axis=0)


def _off(x: np.ndarray, frame: pd.DataFrame, times: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Mean less trial at a shift [s], a marker's offset in the hand's frame and one in the room's [m]."""
    place, turn = _at(frame, times + x[0])
    return (mean - (place + rotated(turn, x[1:4]).T + x[4:])).ravel()


def run(folder: Path) -> dict:
    """Verdicts of SPLITS random halves."""
    with tempfile.TemporaryDirectory() as into:
        frames: list[Any] = [pd.read_csv(p) for p in prepare(folder, Path(into))]
    places, times, shifts = aligned(frames)
    trials = [
        Trial(f"trial {k}", times, dict(zip("xyz", place.T, strict=True))) for k, place in enumerate(places)
    ]
    edges = np.array([EVERY * (i + 1) for i in range(len(MOVES) - 1)])
    task = SequenceTask(MOVES, tuple("xyz"))
    rng, chances = np.random.default_rng(0), []
    for number in range(SPLITS):
        order = rng.permutation(len(trials))
        half = len(trials) // 2
        first, second = ([trials[i] for i in part] for part in (order[:half], order[half:]))
        boundaries = {t.file: edges for t in trials}
        located, gap = detect(align(first, second, task, boundaries=boundaries), seed=number)
        chances.append((float(located.p_value), bool(gap)))
    scatter = np.std(np.array(places), axis=0, ddof=1)
    return {
        "trials": len(trials),
        "splits": SPLITS,
        "false_alarms": sum(gap for _, gap in chances),
        "p_values": [round(p, 4) for p, _ in chances],
        "shift_sd_s": round(float(shifts.std(ddof=1)), 3),
        "scatter_mm": round(1e3 * float(np.sqrt(np.mean(scatter**2))), 3),
    }


if __name__ == "__main__":
    run_on_folder(__doc__ or "", run, RESULTS)
