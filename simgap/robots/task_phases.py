"""Phases of a robot's logs by a task's order of states, found by the same HMM as in any plain sequence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.task import AnyTask, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.segment import segment_sequence
from simgap.robots.phases import Phases
from simgap.simulators.recording import Recording


def phases_by_task(recordings: Sequence[Recording], task: AnyTask, where: str = "task") -> Phases:
    """The phases that the task's `sequence` names, in each log where the HMM finds them.

    InputError for a task of blocks, a channel that the logs do not have, and a log that does not follow the
    task.
    """
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
