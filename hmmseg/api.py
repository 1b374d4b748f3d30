"""The public functions: they take paths, tables and arrays as well as what was read already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, SequenceTask, Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.segmentation.align import align as align_blocks
from hmmseg.segmentation.spans import Segmentation
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import SequenceModel
from hmmseg.sequence.segment import segment_sequence

Source = Any  # a path, a DataFrame, a dict of arrays, or what the readers give


def read_trials(trials: Source | Sequence[Source], rig: Source = None, task: Source = None) -> list[Trial]:
    """Trials from one source or several; InputError for anything at fault."""
    several = isinstance(trials, Sequence) and not isinstance(trials, str)
    return [Trial.read(each, rig, task) for each in (trials if several else [trials])]


def block_task(task: Source) -> BlockTask:
    """A task of blocks; InputError for a plain ordered one."""
    found = Task.read(task)
    if not isinstance(found, BlockTask):
        raise InputError("task", "a plain ordered task has no blocks", "objects and moves")
    return found


def align(trials: Source | Sequence[Source], task: Source, rig: Source) -> AlignedTrials:
    """Fit the switching model to trials of one task of blocks, pooled, and align each of them.

    Every argument may be a path, a table or what `Trial.read`, `Task.read` and `Rig.read` give. Trials
    that do not fit their task say so in `segmentations[i].failed`; InputError for input at fault.
    """
    hand = Rig.read(rig)
    return align_blocks(read_trials(trials, hand), block_task(task), hand)


def segment(
    trials: Source | Sequence[Source],
    task: Source,
    rig: Source = None,
    model: SequenceModel | None = None,
    seed: int = 0,
) -> list[Segmentation]:
    """Subtasks of every trial with the uncertainty of each boundary.

    A task of blocks needs its `rig`; a plain ordered task takes a `model` from `fit`, or learns one from
    these trials. InputError for input at fault.
    """
    order = Task.read(task)
    if isinstance(order, SequenceTask):
        return segment_sequence(read_trials(trials, task=order), order, model, seed)
    if rig is None:
        raise InputError("rig", "missing", "the nominal hand of a task of blocks")
    return align(trials, order, rig).segmentations


def fit(
    trials: Source | Sequence[Source],
    task: Source,
    labels: Mapping[str, Sequence[float]] | None = None,
    seed: int = 0,
) -> SequenceModel:
    """Emissions and durations of a plain ordered task, from labels of some trials or none.

    `labels`: boundaries [s] by the trial's name. InputError for input at fault.
    """
    order = Task.read(task)
    if not isinstance(order, SequenceTask):
        raise InputError("task", "a task of blocks needs no fit", 'sequence = ["approach", ...]')
    return fit_sequence(read_trials(trials, task=order), order, labels, seed)
