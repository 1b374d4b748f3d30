"""The public functions, which take paths, tables and arrays as well as objects that were read before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hmmseg.contact.decompose import Decomposition
from hmmseg.contact.decompose import decompose as decompose_task
from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, SequenceTask, Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials
from hmmseg.segmentation.align import align as align_blocks
from hmmseg.segmentation.spans import Segmentation
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import SequenceModel, load_model
from hmmseg.sequence.segment import segment_sequence

Source = Any  # a path, a DataFrame, a dict of arrays, or what the readers give


def read_trials(trials: Source | Sequence[Source], rig: Source = None, task: Source = None) -> list[Trial]:
    """Trials from one source or several; InputError for anything at fault."""
    several = isinstance(trials, Sequence) and not isinstance(trials, str)
    if several and not trials:
        raise InputError("trials", "none given", "at least one trial")
    return [Trial.read(each, rig, task) for each in (trials if several else [trials])]


def block_task(task: Source) -> BlockTask:
    """A task of blocks; InputError for a plain ordered one."""
    found = Task.read(task)
    if not isinstance(found, BlockTask):
        raise InputError("task", "a plain ordered task has no blocks", "objects and moves")
    return found


def decompose(task: Source) -> Decomposition:
    """Subtasks of a task, and the subtasks that reveal each object's properties.

    Args:
        task: A path, a dict, or the result of `Task.read`.

    Returns:
        The subtasks in order, the signals they need, and by object and property the evidence, or the reason
        why there is none.

    Raises:
        InputError: The description contradicts itself.

    >>> from hmmseg import decompose, example_folder
    >>> found = decompose(example_folder() / "task.toml")
    >>> [subtask.name for subtask in found.subtasks][:5]
    ['pregrasp', 'pickup', 'carry', 'place', 'release']
    >>> found.properties["block1"]["height"].evidence[0].subtasks  # block2's pickup and place
    (5, 7)
    """
    return decompose_task(Task.read(task))


def align(trials: Source | Sequence[Source], task: Source, rig: Source) -> AlignedTrials:
    """Fit the hidden Markov model to pooled trials of one task of blocks, and align each trial.

    Args:
        trials: One source or several: paths, tables, or results of `Trial.read`.
        task: A path, a dict, or the result of `Task.read`.
        rig: The nominal hand: a path, a dict, or the result of `Rig.read`.

    Returns:
        All trials with their alignments. Those that do not fit the task say so in `segmentations[i].failed`.

    Raises:
        InputError: A source is invalid, or the task is not one of blocks.

    >>> from hmmseg import align, example_folder
    >>> folder = example_folder()
    >>> aligned = align(folder / "trial_01.csv", folder / "task.toml", folder / "rig.toml")
    >>> first = aligned.segmentations[0]
    >>> first.complete, len(first.spans)
    (True, 9)
    """
    hand = Rig.read(rig)
    return align_blocks(read_trials(trials, hand), block_task(task), hand)


def segment(
    trials: Source | Sequence[Source],
    task: Source,
    rig: Source = None,
    model: SequenceModel | str | Path | None = None,
) -> list[Segmentation]:
    """Subtasks of every trial with the uncertainty of each boundary.

    Args:
        trials: One source or several: paths, tables, or results of `Trial.read`.
        task: A path, a dict, or the result of `Task.read`.
        rig: The nominal hand, which a task of blocks needs.
        model: Of a plain ordered task, from `fit`, or a file of `hmmseg fit`; learned from these trials by
            default.

    Returns:
        One segmentation a trial, with times in s.

    Raises:
        InputError: A source is invalid or missing.

    >>> import pandas as pd
    >>> from hmmseg import example_folder, segment
    >>> folder = example_folder()
    >>> trial = pd.read_csv(folder / "trial_01.csv")  # a table instead of a path
    >>> found = segment(trial, folder / "task.toml", folder / "rig.toml")[0]
    >>> carry = found.spans[2]
    >>> carry.subtask, carry.object, round(carry.end - carry.start, 1)
    ('carry', 'block1', 1.6)
    """
    order = Task.read(task)
    if isinstance(order, SequenceTask):
        learned = load_model(model, order) if isinstance(model, str | Path) else model
        return segment_sequence(read_trials(trials, task=order), order, learned)
    if rig is None:
        raise InputError("rig", "missing", "the nominal hand of a task of blocks")
    return align(trials, order, rig).segmentations


def fit(
    trials: Source | Sequence[Source],
    task: Source,
    labels: Source = None,
) -> SequenceModel:
    """Learn emissions and durations of a plain ordered task, from labels of some trials or none.

    Args:
        trials: One source or several: paths, tables, or results of `Trial.read`.
        task: A path, a dict, or the result of `Task.read`.
        labels: Known boundaries: one entry for each trial or a dict by the trials' names, or a folder or
            table as for `hmmseg fit --labels`. An entry holds times [s], None where unknown, or
            {subtask: start [s]}.

    Returns:
        A model for `segment`.

    Raises:
        InputError: A source is invalid, or the task is one of blocks.

    >>> import numpy as np
    >>> from hmmseg import fit, segment
    >>> t = np.arange(0.0, 6.0, 0.02)
    >>> noise = np.random.default_rng(0).normal(0.0, 0.05, (4, t.size))
    >>> trials = [{"t": t, "force": np.where(t < 2.0 + 0.3 * k, 0.0, 3.0) + noise[k]} for k in range(4)]
    >>> model = fit(trials, {"sequence": ["approach", "press"]})
    >>> found = segment(trials[0], {"sequence": ["approach", "press"]}, model=model)[0]
    >>> abs(found.spans[1].start - 2.0) < 0.1  # seconds
    True
    """
    order = Task.read(task)
    if not isinstance(order, SequenceTask):
        raise InputError("task", "a task of blocks needs no fit", 'sequence = ["approach", ...]')
    return fit_sequence(read_trials(trials, task=order), order, labels)
