"""Segment trials of a block task: fit, forced alignment, boundary posteriors, fit to the task.

Recordings are cut into rounds (of a task done once: all of each), each round is compared with the task, those
that fit are fitted together, so that they share blocks, biases and pads, and every boundary gets a posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, subtasks
from hmmseg.hand.read import LongRecording
from hmmseg.hand.signals import Signals, task_space, timely, with_heights
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.levels import decisive
from hmmseg.segmentation.boundaries import BoundaryPosterior, Kind
from hmmseg.segmentation.changes import Change, discrepancies
from hmmseg.segmentation.conformity import (
    Conformity,
    at,
    examine,
    explain,
    plan,
    task_boundaries,
)
from hmmseg.segmentation.emissions import WINDOW, Features, features, thin, without
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.pads import LEAD_SD, Sensing, read_again, sense
from hmmseg.segmentation.posteriors import boundary_posteriors, contact_changes, to_spans
from hmmseg.segmentation.rounds import (
    OnDisk,
    Recorded,
    cut,
    merge_point,
    one_round,
    part,
    round_tasks,
    slices,
)
from hmmseg.segmentation.spans import Failure, Segmentation, Span, trials_table
from hmmseg.tables import Brief, Tabled

Spans = Sequence[tuple[float, float]]
LOCAL_RATE = 100.0  # chosen: Hz; contacts are located at up to this rate, at which readings share no noise


@dataclass(frozen=True)
class Reading:
    """One recording, or round: `fine` signals locate contacts, `thinned` ones are aligned by `features`.

    `ends` [s]: its first and last time.
    """

    fine: Signals
    thinned: Signals
    features: Features
    ends: tuple[float, float]


@dataclass(frozen=True)
class Pool:
    """All recordings as they were read last, the fit of those that fit, and what they show of the hand.

    `changes` are those of each fitted recording; `discrepancy` as in `discrepancies`. `remarks` tell
    people what contradicts the rig.
    """

    readings: list[Reading]
    fit: Fit
    sensing: Sensing
    changes: list[list[Change | None]] = field(default_factory=list)
    discrepancy: dict[tuple[Kind, int], float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    late: bool = False


def pooled(
    parts: Sequence[tuple[Recorded, slice]], fitting: Sequence[int], steps: tuple[Subtask, ...], rig: Rig,
    taps: Sequence[Spans],
) -> Pool:  # fmt: skip
    """One fit of all `parts` of recordings that are `fitting`; a second one where their forces come late.

    `taps` [s] of each part are touches that belong to no subtask.
    """

    def once(late: Sensing | None = None) -> tuple[list[Reading], Fit, Sensing]:
        signals = (part(recorded, samples) for recorded, samples in parts)
        signals = signals if late is None else (read_again(s, late) for s in signals)
        readings = [_read(s, rig, t) for s, t in zip(signals, taps, strict=True)]
        fitted = fit([readings[i].features for i in fitting], steps)
        fine = [readings[i].fine for i in fitting]
        # Forces of a wrist's fingers show no pads of their own.
        again = late is not None or any(r.fine.touches for r in readings)
        paths = [(readings[i].thinned.t, a.path) for i, a in zip(fitting, fitted.posteriors, strict=True)]
        return readings, fitted, sense(fine, paths, steps, fitted.parameters, rig, again)

    readings, fitted, sensing = once()
    if sensing.late:
        read_anew, fitted_anew, again = once(sensing)
        if not again.heights_gain(sensing) > decisive(0.5):  # a sensor's delay is common to all forces
            sensing = replace(sensing, delay=0.0, delay_sd=LEAD_SD, late=False, filter=False)
        else:
            readings, fitted = read_anew, fitted_anew
            doubt = float(np.hypot(again.delay_sd, sensing.delay_sd))
            sensing = replace(again, late=True, filter=sensing.filter, delay=sensing.delay, delay_sd=doubt)
    remarks, late = sensing.remarks(rig), sensing.late
    sensing = replace(sensing, delay=0.0) if late else sensing  # what was read again is late no more
    changes = [
        contact_changes(readings[i].fine, readings[i].thinned, sensing, steps, fitted.parameters, alignment)
        for i, alignment in zip(fitting, fitted.posteriors, strict=True)
    ]
    discrepancy = discrepancies([c for own in changes for c in own if c is not None])
    return Pool(readings, fitted, sensing, changes, discrepancy, remarks, late)


def _read(signals: Signals, rig: Rig, taps: Spans) -> Reading:
    thinned = thin(signals, window=WINDOW)
    fine = thin(signals, LOCAL_RATE, WINDOW)
    return Reading(
        fine, thinned, without(features(thinned, rig), taps), (float(signals.t[0]), float(signals.t[-1]))
    )


@dataclass(frozen=True)
class Piece:
    """One round of one recording (of a task done once: all of it), aligned.

    `first`, `last` [s] are its ends; `failed` counts subtasks from its own first.
    """

    boundaries: tuple[BoundaryPosterior, ...]
    spans: tuple[Span, ...]
    failed: Failure | None
    evidence: float
    first: float
    last: float


def aligned_rounds(
    recordings: Sequence[Recorded],
    coarse: Sequence[Features],
    task: BlockTask,
    rig: Rig,
    all_fit: bool = False,
) -> tuple[Pool, list[list[Piece]]]:
    """What all recordings show together, and the rounds of each, aligned.

    `coarse` are features of each recording, thinned. `all_fit`: all are taken to fit.
    """
    if task.repeat == 1 or all_fit:
        every = [[slice(0, r.t.size)] for r in recordings]
        verdicts = [[v] for v in examine(coarse, [task] * len(recordings))]
    else:
        every, verdicts = _rounds(recordings, coarse, task, rig)
    steps = subtasks(task if all_fit else one_round(task))
    flat = [(r, p) for r, own in zip(recordings, every, strict=True) for p in own]
    of = [v for own in verdicts for v in own]
    fitting = [i for i, verdict in enumerate(of) if all_fit or verdict.failing is None]
    taps = [v.free.taps for v in of]
    if fitting:
        pool = pooled(flat, fitting, steps, rig, taps)
    else:  # what is known of the sensors, and no alignment
        parameters = of[0].free.parameters
        readings = [_read(part(r, p), rig, t) for (r, p), t in zip(flat, taps, strict=True)]
        pool = Pool(readings, Fit(parameters, ()), sense([], [], (), parameters, rig))
    position = {i: j for j, i in enumerate(fitting)}
    pieces = []
    for i, (reading, verdict) in enumerate(zip(pool.readings, of, strict=True)):
        if i not in position:
            pieces.append(_departed(reading, steps, verdict, pool))
            continue
        alignment, changes = pool.fit.posteriors[position[i]], pool.changes[position[i]]
        found = boundary_posteriors(
            changes, pool.discrepancy, reading.thinned.t, alignment, reading.fine.touches
        )
        spans = to_spans(steps, found, *reading.ends)
        pieces.append(Piece(found, spans, None, float(alignment.log_evidence), *reading.ends))
    each = iter(pieces)
    return pool, [[next(each) for _ in own] for own in every]


def performed(task: BlockTask, pieces: Sequence[Sequence[Piece]]) -> BlockTask:
    """The task with its number of rounds (of several recordings with an unknown number, the most)."""
    return task if task.repeat != "unknown" else replace(task, repeat=max(len(own) for own in pieces))


def _rounds(
    recordings: Sequence[Recorded], coarse: Sequence[Features], task: BlockTask, rig: Rig
) -> tuple[list[list[slice]], list[list[Conformity]]]:
    """Samples and verdict of every round of every recording."""
    cuts = [cut(f, task) for f in coarse]
    while True:
        every = [slices(r.t, at) for r, at in zip(recordings, cuts, strict=True)]
        parts = [[features(thin(part(r, p)), rig) for p in own]
                 for r, own in zip(recordings, every, strict=True)]  # fmt: skip
        tasks = [own for p in parts for own in round_tasks(task, len(p))]
        found = iter(examine([f for own in parts for f in own], tasks))
        verdicts = [[next(found) for _ in own] for own in parts]
        changed = False
        for i, own in enumerate(verdicts):
            if task.repeat != "unknown" and len(own) > task.repeat:
                k = merge_point(own, [f.t for f in parts[i]])
                if k is not None:
                    del cuts[i][k]
                    changed = True
        if not changed:
            return every, verdicts


def _departed(reading: Reading, steps: tuple[Subtask, ...], verdict: Conformity, pool: Pool) -> Piece:
    """A trial aligned with the order that it shows in place of its task's."""
    assert verdict.failing is not None
    shown = plan(verdict, steps)
    found, evidence = (), verdict.log_evidence
    if any(s.state != FREE for s in shown.steps):  # something is held: it is fitted to the order it shows
        own = fit([reading.features], shown.steps, shown.start)
        alignment = own.posteriors[0]
        evidence = float(alignment.log_evidence)
        changes = contact_changes(
            reading.fine, reading.thinned, pool.sensing, shown.steps, own.parameters, alignment
        )
        found = boundary_posteriors(
            changes, pool.discrepancy, reading.thinned.t, alignment, reading.fine.touches
        )
    ends = reading.ends
    boundaries = task_boundaries(shown, found, len(steps), *ends)
    every = to_spans(shown.steps, found, *ends)
    spans = (*every[: shown.num_before], *every[len(every) - shown.num_after :])
    step = steps[verdict.failing]
    reason = explain(verdict, steps, [span.start for span in every])
    return Piece(boundaries, spans, Failure(step.index, step.name, step.object, reason), evidence, *ends)


def joined(
    file: str, last: float, rate: float, pieces: Sequence[Piece], steps: tuple[Subtask, ...], number: int,
    open_end: bool, remarks: tuple[str, ...], recorded: Signals | None = None,
) -> tuple[Segmentation, tuple[BoundaryPosterior, ...], np.ndarray]:  # fmt: skip
    """One recording up to `last` [s], of a median rate [Hz], from its rounds.

    Its task has `number` of them (`open_end`: at most). Also all boundaries'
    posteriors, and which subtasks it shows as the task has them (num_subtasks,).
    """
    per_round = (len(steps) - 1) // number
    boundaries = [b for piece in pieces[:number] for b in piece.boundaries]
    boundaries += [at(last)] * (len(steps) - 1 - len(boundaries))
    present = np.zeros(len(steps), bool)
    failures, spans = [], []
    for r, piece in enumerate(pieces[:number]):
        base, stop = r * per_round, per_round if piece.failed is None else piece.failed.index
        present[base : base + stop + (piece.failed is None)] = True
        spans = _continued(spans, piece.spans)
        if piece.failed is not None:
            index = base + piece.failed.index
            failures.append(replace(piece.failed, index=index, repetition=r + 1 if number > 1 else None))
    if len(pieces) > number:
        grip = pieces[number].boundaries[0].quantile(0.5)
        reason = f"the recording goes on after the task's end with another grip at {grip:.2f} s"
        failures.append(Failure(steps[-1].index, steps[-1].name, steps[-1].object, reason, number + 1))
    elif len(pieces) < number and not open_end:
        step = steps[len(pieces) * per_round + 1]
        reason = "the recording ends before it"
        failures.append(Failure(step.index, step.name, step.object, reason, len(pieces) + 1))
    segmentation = Segmentation(
        file, rate, sum(p.evidence for p in pieces), tuple(spans), failures[0] if failures else None,
        len(pieces) if number > 1 or open_end else None, tuple(failures), recorded,
        remarks,
    )  # fmt: skip
    return segmentation, tuple(boundaries), present


def _continued(before: list[Span], after: Sequence[Span]) -> list[Span]:
    """Spans of the rounds so far and of the next; the free motion between them is one release."""
    if before and after and before[-1].state == FREE and after[0].state == FREE:
        free = replace(before[-1], end=after[0].end, end_sd=after[0].end_sd, end_90=after[0].end_90)
        return [*before[:-1], free, *after[1:]]
    return [*before, *after]


@dataclass(frozen=True, repr=False)
class TrialAlignment(Brief):
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
    posteriors. `late`: forces come later than positions by their sensor's doing.
    """

    task: BlockTask
    rig: Rig
    subtasks: tuple[Subtask, ...]
    fit: Fit
    trials: tuple[TrialAlignment, ...]
    late: bool = False

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
    log evidence is that of the order it shows. Of a repeated task every round is such a trial: one
    that fails leaves the others as they are.

    Args:
        trials: recordings of one hand, at least one.
        task: whose order they follow.
        rig: the nominal hand.
        all_fit: all are taken to fit, whatever they show.
        signals: one a trial, to be read instead of its own.

    Returns:
        The trials with their alignments; `task` has its number of rounds (of several recordings with
        an unknown number, the most).
    """
    if signals is None:
        signals = [timely(task_space(trial, rig), trial, rig) for trial in trials]
    whole = [with_heights(s, trial, rig) for s, trial in zip(signals, trials, strict=True)]
    coarse = [features(thin(s), rig) for s in whole]
    pool, pieces = aligned_rounds(signals, coarse, task, rig, all_fit)
    done = performed(task, pieces)
    steps = subtasks(done)
    number = 1 if all_fit or done.repeat == "unknown" else done.repeat
    found = []
    for trial, s, own in zip(trials, signals, pieces, strict=True):
        last, rate = float(s.t[-1]), float(1.0 / np.median(np.diff(s.t)))
        segmentation, boundaries, present = joined(
            trial.file, last, rate, own, steps, number, task.repeat == "unknown", pool.remarks, s
        )
        thinned = thin(s, window=WINDOW)
        found.append(
            TrialAlignment(trial, s, thinned, features(thinned, rig), boundaries, segmentation, present)
        )
    return AlignedTrials(done, rig, steps, pool.fit, tuple(found), pool.late)


def segment(trials: Sequence[Trial], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segmentation of each trial of one task; all are fitted together."""
    return align(trials, task, rig).segmentations


def segment_long(recording: LongRecording, task: BlockTask, rig: Rig) -> Segmentation:
    """Segmentation of one recording that stays on disk, as `segment` has it.

    It is passed over twice: thinned as a whole, which tells the rounds, and then round by round. Memory holds
    the times and what is read of each round at 100 Hz at most.
    """
    source = OnDisk(recording, rig)
    coarse = [features(source.thinned(), rig)]
    pool, pieces = aligned_rounds([source], coarse, task, rig)
    done = performed(task, pieces)
    number = 1 if done.repeat == "unknown" else done.repeat
    last = float(recording.t[-1])
    return joined(recording.file, last, recording.rate, pieces[0], subtasks(done), number,
                  task.repeat == "unknown", pool.remarks)[0]  # fmt: skip
