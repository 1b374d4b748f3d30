"""Trials that do not fit their task, made by editing trials that do.

Every edit takes a trial and its true boundaries [s] between the nine subtasks of the paper's task,
and gives the edited trial with the index of the first subtask that it does not show. Pieces are
joined with continuous time; positions jump where pieces meet, as they would under a cut.
"""

from collections.abc import Callable, Sequence

import numpy as np

from hmmseg.io.trial import Trial

Edit = Callable[[Trial, Sequence[float]], tuple[Trial, int]]
FORCES = ("fx1", "fy1", "fx2", "fy2")


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


def drop_first(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 falls in mid-carry, and nothing is held from there on."""
    return let_go(trial, b, (b[1] + b[2]) / 2, np.inf), 3


def drop_first_go_on(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 falls in mid-carry; block 2 is moved all the same."""
    return let_go(trial, b, (b[1] + b[2]) / 2, b[3] + 0.3), 3


def drop_second(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 2 falls early in its carry."""
    return let_go(trial, b, b[5] + 0.3 * (b[6] - b[5]), np.inf), 7


def drop_and_retry(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 falls in mid-carry, is gripped again and moved."""
    dropped = let_go(trial, b, b[2] - 0.5, b[2])
    return _concatenate(dropped, (trial.t[0], b[2]), trial, (b[0] - 0.5, np.inf)), 3


def regrasp(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 is moved twice before block 2."""
    return join(trial, (-np.inf, b[3] + 0.5), (b[0] - 0.5, b[3] + 0.5), (b[3] + 0.5, np.inf)), 5


def regrasp_on_ground(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 is let go and gripped again before it is lifted."""
    return join(trial, (-np.inf, b[0] + 0.3), (b[3], b[3] + 0.4), (b[0] - 0.4, np.inf)), 2


def regrasp_placed(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 is gripped again where it was put, and let go again."""
    back = join(trial, (-np.inf, b[3] + 0.4), (b[0] - 0.4, b[0] + 0.3), (b[3], np.inf))
    return back, 5


def no_second_move(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The recording is cut in the free motion between the moves."""
    return join(trial, (-np.inf, (b[3] + b[4]) / 2)), 5


def idle_second_half(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The fingers move but never close on block 2."""
    return let_go(trial, b, b[3] + 0.2, np.inf), 5


def only_free_motion(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """No contact at all."""
    return let_go(trial, b, -np.inf, np.inf), 1


def extra_move(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 1 is moved once more at the end."""
    return join(trial, (-np.inf, np.inf), (b[0] - 1.0, b[3] + 0.5)), 8


def starts_in_carry(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The recording begins with block 1 in the air."""
    return join(trial, (b[1] + 0.4, np.inf)), 0


def starts_in_grip(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The recording begins with block 1 gripped on the ground."""
    return join(trial, (b[0] + 0.15, np.inf)), 0


def stops_in_carry(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The recording stops with block 2 in the air."""
    return join(trial, (-np.inf, (b[5] + b[6]) / 2)), 7


def stops_in_first_pickup(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """The recording stops before block 1 is lifted."""
    return join(trial, (-np.inf, b[0] + 0.3)), 2


def swapped(trial: Trial, b: Sequence[float]) -> tuple[Trial, int]:
    """Block 2 is moved before block 1."""
    middle = (b[3] + b[4]) / 2
    return join(trial, (middle, np.inf), (-np.inf, middle)), 1


EDITS: dict[str, Edit] = {
    edit.__name__: edit
    for edit in (
        drop_first, drop_first_go_on, drop_second, drop_and_retry, regrasp, regrasp_on_ground,
        regrasp_placed, no_second_move, idle_second_half, only_free_motion, extra_move, starts_in_carry,
        starts_in_grip, stops_in_carry, stops_in_first_pickup, swapped,
    )
}  # fmt: skip


def _concatenate(one: Trial, first: tuple[float, float], other: Trial, second: tuple[float, float]) -> Trial:
    a, b = join(one, first), join(other, second)
    step = float(np.median(np.diff(one.t)))
    t = np.concatenate([a.t, b.t - b.t[0] + a.t[-1] + step])
    return Trial(one.file, t, {k: np.concatenate([a.channels[k], b.channels[k]]) for k in a.channels})
