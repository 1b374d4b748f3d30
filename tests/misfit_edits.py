"""Trials that do not fit their task: edits give the trial and the index of the first subtask not shown."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.trial import Trial

STACK = Path(__file__).parent / "data/stack"
RIG = read_rig(STACK / "rig.toml")
TRIALS = [read_trial(STACK / f"trial_0{i}.csv", RIG) for i in (1, 2, 3)]
TRUTH = [json.loads((STACK / f"trial_0{i}.json").read_text())["boundaries"] for i in (1, 2, 3)]

Edit = Callable[[Trial, Sequence[float]], tuple[Trial, int]]
FORCES = ("fx1", "fy1", "fx2", "fy2")
END = np.inf


def join(trial: Trial, *pieces: tuple[float, float]) -> Trial:
    """The samples of the time intervals [start, end) s, one after another."""
    index = np.concatenate([np.flatnonzero((trial.t >= a) & (trial.t < b)) for a, b in pieces])
    step = float(np.median(np.diff(trial.t)))
    t = trial.t[0] + step * np.arange(index.size)
    return Trial(trial.file, t, {name: values[index] for name, values in trial.channels.items()})


def let_go(trial: Trial, boundaries: Sequence[float], start: float, end: float) -> Trial:
    """Forces vanish in [start, end) s: replaced by those of free motion, fingers moving on."""
    silent = np.flatnonzero(trial.t < boundaries[0] - 0.1)
    gone = np.flatnonzero((trial.t >= start) & (trial.t < end))
    channels = dict(trial.channels)
    for name in FORCES:
        channels[name] = channels[name].copy()
        channels[name][gone] = trial.channels[name][silent[np.arange(gone.size) % silent.size]]
    return Trial(trial.file, trial.t, channels)


EDITS: dict[str, Edit] = {
    # Block 1 falls in mid-carry, and nothing is held from there on, or block 2 is moved all the same.
    "drop_first": lambda t, b: (let_go(t, b, (b[1] + b[2]) / 2, END), 3),
    "drop_first_go_on": lambda t, b: (let_go(t, b, (b[1] + b[2]) / 2, b[3] + 0.3), 3),
    # Block 2 falls early in its carry.
    "drop_second": lambda t, b: (let_go(t, b, b[5] + 0.3 * (b[6] - b[5]), END), 7),
    # Block 1 falls in mid-carry, is gripped again and moved.
    "drop_and_retry": lambda t, b: (
        _concatenate(let_go(t, b, b[2] - 0.5, b[2]), (t.t[0], b[2]), t, (b[0] - 0.5, END)), 3),
    # Block 1 is moved twice before block 2; let go and gripped again before it is lifted; or gripped again
    # where it was put, and let go again.
    "regrasp": lambda t, b: (
        join(t, (-END, b[3] + 0.5), (b[0] - 0.5, b[3] + 0.5), (b[3] + 0.5, END)), 5),
    "regrasp_on_ground": lambda t, b: (
        join(t, (-END, b[0] + 0.3), (b[3], b[3] + 0.4), (b[0] - 0.4, END)), 2),
    "regrasp_placed": lambda t, b: (
        join(t, (-END, b[3] + 0.4), (b[0] - 0.4, b[0] + 0.3), (b[3], END)), 5),
    # The recording is cut in free motion between the moves; the fingers never close on block 2, or at all.
    "no_second_move": lambda t, b: (join(t, (-END, (b[3] + b[4]) / 2)), 5),
    "idle_second_half": lambda t, b: (let_go(t, b, b[3] + 0.2, END), 5),
    "only_free_motion": lambda t, b: (let_go(t, b, -END, END), 1),
    # Block 1 is moved once more at the end.
    "extra_move": lambda t, b: (join(t, (-END, END), (b[0] - 1.0, b[3] + 0.5)), 8),
    # The recording begins with block 1 in the air, or gripped on the ground.
    "starts_in_carry": lambda t, b: (join(t, (b[1] + 0.4, END)), 0),
    "starts_in_grip": lambda t, b: (join(t, (b[0] + 0.15, END)), 0),
    # The recording stops with block 2 in the air, or before block 1 is lifted.
    "stops_in_carry": lambda t, b: (join(t, (-END, (b[5] + b[6]) / 2)), 7),
    "stops_in_first_pickup": lambda t, b: (join(t, (-END, b[0] + 0.3)), 2),
    # Block 2 is moved before block 1.
    "swapped": lambda t, b: (join(t, ((b[3] + b[4]) / 2, END), (-END, (b[3] + b[4]) / 2)), 1)}  # fmt: skip


def _concatenate(one: Trial, first: tuple[float, float], other: Trial, second: tuple[float, float]) -> Trial:
    a, b = join(one, first), join(other, second)
    step = float(np.median(np.diff(one.t)))
    t = np.concatenate([a.t, b.t - b.t[0] + a.t[-1] + step])
    return Trial(one.file, t, {k: np.concatenate([a.channels[k], b.channels[k]]) for k in a.channels})
