"""Phases of logs: stretches by name, given by a task or told by motion alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hmmseg.errors import InputError
from simgap.robots.rows import Rows
from simgap.robots.windows import FLIES, REGIMES, Window, moves, reaches
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

if TYPE_CHECKING:
    from hmmseg.io.task import AnyTask


@dataclass(frozen=True)
class Phases:
    """`names` of phases, and of each log its boundaries [s] (ascending) with the phase that begins there."""

    names: tuple[str, ...]
    starts: tuple[np.ndarray, ...]
    number: tuple[np.ndarray, ...]

    def of(self, rows: Rows) -> np.ndarray:
        """The phase (N,) of each row."""
        out = np.zeros(rows.log.size, int)
        for log in np.unique(rows.log):
            mine = rows.log == log
            at = np.searchsorted(self.starts[log], rows.time[mine], side="right") - 1
            out[mine] = self.number[log][np.maximum(at, 0)]
        return out


def phases_of(simulator: Simulator, recordings: Sequence[Recording], windows: Sequence[Window]) -> Phases:
    """By contact, where the simulator tells any in the windows of logs; else by motion."""
    if all(w.regime == FLIES for w in windows):
        return phases_by_motion(simulator, recordings)
    of = [[w for w in windows if w.log == number] for number in range(len(recordings))]
    starts = [np.array([log.t[w.begin] for w in mine]) for log, mine in zip(recordings, of, strict=True)]
    number = [np.array([REGIMES.index(w.regime) for w in mine]) for mine in of]
    return Phases(REGIMES, tuple(starts), tuple(number))


def phases_by_motion(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """`still` and `moving`: half seconds in which any position goes further than a hundredth of its range."""
    reach = reaches(simulator, recordings)
    if not reach:
        none = [np.zeros(1, int) for _ in recordings]
        return Phases(("whole",), tuple(np.array([r.t[0]]) for r in recordings), tuple(none))
    starts, numbers = [], []
    for log in recordings:
        edges = np.arange(log.t[0], log.t[-1], min(0.5, 0.25 * float(log.t[-1] - log.t[0])))
        rows = np.searchsorted(log.t, edges)
        ends = np.append(rows[1:], len(log))
        going = [moves(log, int(a), int(b), reach) for a, b in zip(rows, ends, strict=True)]
        changes = np.flatnonzero(np.diff(np.array(going, int), prepend=-1))
        starts.append(edges[changes])
        numbers.append(np.array(going, int)[changes])
    return Phases(("still", "moving"), tuple(starts), tuple(numbers))


def phases_by_task(recordings: Sequence[Recording], task: AnyTask, where: str = "task") -> Phases:
    """The phases that the task's `sequence` names, in each log where the HMM finds them.

    InputError for a task of blocks, a channel that the logs do not have, and a log that does not follow the
    task.
    """
    from hmmseg.io.task import SequenceTask
    from hmmseg.io.trial import Trial
    from hmmseg.sequence.segment import segment_sequence  # slow to import

    if not isinstance(task, SequenceTask):
        raise InputError(where, "is a task of blocks", 'sequence = ["approach", ...]')
    channels = task.channels or tuple(recordings[0].columns)
    for name in channels:
        if name not in recordings[0].columns:
            raise InputError(f"{where}: channels", f"no column {name}", ", ".join(recordings[0].columns))
    trials = [Trial(r.name, r.t, {n: r[n] for n in channels}) for r in recordings]
    starts, numbers = [], []
    for found in segment_sequence(trials, task):
        if found.failed is not None:
            raise InputError(found.file, f"does not follow {where}: {found.failed}")
        numbers.append(np.array([task.sequence.index(s.subtask) for s in found.spans]))
        starts.append(np.array([s.start for s in found.spans]))
    return Phases(task.sequence, tuple(starts), tuple(numbers))
