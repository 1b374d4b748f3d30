"""Phases of logs: stretches by name, given by a task or told by motion alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hmmseg.errors import InputError
from simgap.robots.rows import Rows
from simgap.robots.windows import FREE, moves, reaches
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

if TYPE_CHECKING:
    from hmmseg.io.task import AnyTask

WHOLE = "whole"


@dataclass(frozen=True)
class Phases:
    """`names` of phases, and of each log its boundaries [s] (ascending) with the phase that begins there.

    `free` are phases without contacts, where others have some: a window in which anything touches is none of
    them, for what a contact does goes on after it.
    """

    names: tuple[str, ...]
    starts: tuple[np.ndarray, ...]
    number: tuple[np.ndarray, ...]
    free: frozenset[int] = frozenset()

    def of(self, rows: Rows) -> np.ndarray:
        """The phase (N,) of each row."""
        out = np.zeros(rows.log.size, int)
        for log in np.unique(rows.log):
            mine = rows.log == log
            at = np.searchsorted(self.starts[log], rows.time[mine], side="right") - 1
            found = self.number[log][np.maximum(at, 0)]
            wrong = np.isin(found, list(self.free)) & rows.touching[mine]
            right = np.flatnonzero(~np.isin(found, list(self.free)))
            if wrong.any() and right.size:
                before = np.maximum(np.searchsorted(right, np.flatnonzero(wrong)) - 1, 0)
                found = np.array(found)
                found[wrong] = found[right[before]]
            out[mine] = found
        return out


def one_phase(recordings: Sequence[Recording]) -> Phases:
    """Every log is one phase."""
    first = tuple(np.array([r.t[0]]) for r in recordings)
    return Phases((WHOLE,), first, tuple(np.zeros(1, int) for _ in recordings))


MANY = 4  # chosen: states of contact that are told apart at most, those that last longest


def phases_of(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """By motion, and where the simulator tells contacts, by what touches: a model is off by more there."""
    moving = phases_by_motion(simulator, recordings)
    states = getattr(simulator, "contact_states", None)
    labelled = [] if states is None else [states(log) for log in recordings]
    common = Counter(label for _, labels in labelled for label in labels).most_common()
    if len(common) < 2:
        return moving
    kept = [label for label, _ in common[:MANY]]
    names, starts, numbers = {}, [], []
    for number, (log, (times, labels)) in enumerate(zip(recordings, labelled, strict=True)):
        going = np.searchsorted(moving.starts[number], times, side="right") - 1
        motion = [moving.names[k] for k in moving.number[number][np.maximum(going, 0)]]
        both = [f"{m}, {k if k in kept else OTHER}" for m, k in zip(motion, labels, strict=True)]
        changes = [i for i in range(len(both)) if i == 0 or both[i] != both[i - 1]]
        starts.append(np.array([log.t[0], *times[changes[1:]]]))
        numbers.append(np.array([names.setdefault(both[i], len(names)) for i in changes]))
    free = frozenset(k for name, k in names.items() if name.endswith(f", {FREE}"))
    return Phases(tuple(names), tuple(starts), tuple(numbers), free)


OTHER = "other contacts"


def phases_by_motion(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """`still` and `moving`: half seconds in which any position goes further than a hundredth of its range."""
    reach = reaches(simulator, recordings)
    if not reach:
        return one_phase(recordings)
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
