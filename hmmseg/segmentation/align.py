"""Segment trials of a block task: fit, forced alignment, boundary posteriors, fit to the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.contact.decompose import Subtask, subtasks
from hmmseg.hand.bridging import with_heights
from hmmseg.hand.rates import timely
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.long import LongRecording
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.boundaries import BoundaryPosterior
from hmmseg.segmentation.conformity import MAX_RATE
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.features import WINDOW, features, thin
from hmmseg.segmentation.fit import Fit
from hmmseg.segmentation.pieces import aligned_rounds, joined, performed
from hmmseg.segmentation.recorded import InMemory, OnDisk
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.tables import trials_table
from hmmseg.tables import Tabled


@dataclass(frozen=True)
class TrialAlignment:
    """What later stages need of one aligned trial: the trial, its signals and boundary posteriors.

    `signals` are the recording's, `thinned` and `features` those that the emissions score. `present`
    (num_subtasks,): which subtasks it shows as the task has them.
    """

    trial: Trial
    signals: Signals
    thinned: Signals
    features: Features
    boundaries: tuple[BoundaryPosterior, ...]
    segmentation: Segmentation
    present: np.ndarray


@dataclass(frozen=True, repr=False)
class AlignedTrials(Tabled):
    """All trials of one task; those that fit it are aligned together by one fit.

    `fit` pools the trials, or the rounds of a repeated task, that fit, in order; without any it has no
    posteriors.
    """

    task: BlockTask
    rig: Rig
    subtasks: tuple[Subtask, ...]
    fit: Fit
    trials: tuple[TrialAlignment, ...]

    @property
    def segmentations(self) -> list[Segmentation]:
        """One segmentation a trial."""
        return [trial.segmentation for trial in self.trials]

    def to_json(self) -> dict[str, Any]:
        """The trials of `segment`'s JSON document."""
        return {"trials": [s.to_json() for s in self.segmentations]}

    def tables(self) -> list[Any]:
        """One row a trial: whether it fits its task."""
        return [trials_table(self.segmentations)]

    def plot(self, trial: int = 0, path: str | Path | None = None) -> list[Any]:
        """One trial's signals over the coloured subtasks; the axes. Saved where a path is given."""
        return self.segmentations[trial].plot(path)


def align(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    all_fit: bool = False,
    signals: Sequence[Signals] | None = None,
) -> AlignedTrials:
    """Fit the switching model to the trials, pooled, and align each of them.

    A trial that does not fit its task is kept out of the pool and aligned with the order that it
    shows instead: its subtasks before `failed` are the task's, boundaries after it are not. Its
    log evidence is that of the order it shows. `all_fit`: all are taken to fit, whatever they show.

    Of a repeated task every round is such a trial: one that fails leaves the others as they are. `task`
    of the result has its number of rounds (of several recordings with an unknown number, the most).
    `signals`: to be read instead of the trials' own.
    """
    if signals is None:
        signals = [timely(task_space(trial, rig), trial, rig) for trial in trials]
    whole = [with_heights(s, trial, rig) for s, trial in zip(signals, trials, strict=True)]
    coarse = [features(thin(s, MAX_RATE), rig) for s in whole]
    pool, pieces = aligned_rounds([InMemory(s) for s in signals], coarse, task, rig, all_fit)
    done = performed(task, pieces)
    steps = subtasks(done)
    number = 1 if all_fit or done.repeat == "unknown" else done.repeat
    trial_alignments = []
    for trial, s, own in zip(trials, signals, pieces, strict=True):
        segmentation, boundaries, present = joined(
            trial.file,
            float(s.t[-1]),
            float(1.0 / np.median(np.diff(s.t))),
            own,
            steps,
            number,
            task.repeat == "unknown",
            pool.remarks,
            s,
        )
        thinned = thin(s, window=WINDOW)
        trial_alignments.append(
            TrialAlignment(trial, s, thinned, features(thinned, rig), boundaries, segmentation, present)
        )
    return AlignedTrials(done, rig, steps, pool.fit, tuple(trial_alignments))


def segment(trials: Sequence[Trial], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segmentation of each trial of one task; all are fitted together."""
    return align(trials, task, rig).segmentations


def segment_long(recording: LongRecording, task: BlockTask, rig: Rig) -> Segmentation:
    """Segmentation of one recording that stays on disk, as `segment` has it.

    It is passed over twice: thinned as a whole, which tells the rounds, and then round by round. Memory holds
    the times and what is read of each round at 100 Hz at most.
    """
    source = OnDisk(recording, rig)
    coarse = [features(source.thinned(MAX_RATE), rig)]
    pool, pieces = aligned_rounds([source], coarse, task, rig)
    done = performed(task, pieces)
    number = 1 if done.repeat == "unknown" else done.repeat
    steps = subtasks(done)
    return joined(
        recording.file,
        float(recording.t[-1]),
        recording.rate,
        pieces[0],
        steps,
        number,
        task.repeat == "unknown",
        pool.remarks,
    )[0]
