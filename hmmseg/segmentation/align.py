"""Segment trials of a block task: fit, forced alignment, boundary posteriors, conformity.

Recordings are cut into rounds (a task done once is a single round), and each round is compared with the task.
Rounds that conform are fitted jointly and share blocks, biases and pads. Every boundary gets a posterior.
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
from hmmseg.segmentation.boundaries import BoundaryPosterior, Kind
from hmmseg.segmentation.changes import Change, discrepancies
from hmmseg.segmentation.conformity import Conformity, examine, explain, plan, point_mass, task_boundaries
from hmmseg.segmentation.emissions import WINDOW, Features, features, thin, without
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.pads import LEAD_SD, Sensing, read_again, sense
from hmmseg.segmentation.posteriors import Reading, boundary_posteriors, contact_changes, to_spans
from hmmseg.segmentation.rounds import (
    OnDisk,
    Recorded,
    find_cuts,
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


def _read(signals: Signals, rig: Rig, taps: Spans) -> Reading:
    thinned = thin(signals, window=WINDOW)
    fine = thin(signals, LOCAL_RATE, WINDOW)
    ends = float(signals.t[0]), float(signals.t[-1])
    return Reading(fine, thinned, without(features(thinned, rig), taps), ends)


@dataclass(frozen=True)
class Pool:
    """All recordings as last read, the joint fit of those that conform, and what they show of the hand.

    `changes`: evidence of each fitted recording; `discrepancy`: as in `discrepancies`. `remarks`:
    contradictions to the rig, for people. `late`: forces lag behind positions because of their sensor.
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
    """Fit the `fitting` ones among all `parts` of recordings; refit if their forces turn out to be late.

    `taps` [s]: per part, touches that belong to no subtask.
    """

    def once(late: Sensing | None = None) -> tuple[list[Reading], Fit, Sensing]:
        signals = (part(recorded, samples) for recorded, samples in parts)
        signals = signals if late is None else (read_again(s, late) for s in signals)
        readings = [_read(s, rig, t) for s, t in zip(signals, taps, strict=True)]
        fitted = fit([readings[i].features for i in fitting], steps)
        fine = [readings[i].fine for i in fitting]
        # The fingers derived from a wrist sensor have no pads of their own to learn about.
        again = late is not None or any(r.fine.touches for r in readings)
        paths = [(readings[i].thinned.t, a.path) for i, a in zip(fitting, fitted.posteriors, strict=True)]
        return readings, fitted, sense(fine, paths, steps, fitted.parameters, rig, again)

    readings, fitted, sensing = once()
    if sensing.late:
        read_anew, fitted_anew, again = once(sensing)
        if again.heights_gain(sensing) < 0:  # a sensor delays vertical forces as well
            sensing = replace(sensing, delay=0.0, delay_sd=LEAD_SD, late=False, filter=False)
        else:
            readings, fitted = read_anew, fitted_anew
            doubt = float(np.hypot(again.delay_sd, sensing.delay_sd))
            known = replace(sensing, shear=again.shear, friction=again.friction)
            sensing = replace(known, rests=again.rests, noise=again.noise, delay_sd=doubt)
    remarks, late = sensing.remarks(rig), sensing.late
    sensing = replace(sensing, delay=0.0) if late else sensing  # re-read forces are on time
    changes = [
        contact_changes(readings[i], sensing, steps, fitted.parameters, alignment)
        for i, alignment in zip(fitting, fitted.posteriors, strict=True)
    ]
    discrepancy = discrepancies([c for own in changes for c in own if c is not None])
    return Pool(readings, fitted, sensing, changes, discrepancy, remarks, late)


@dataclass(frozen=True)
class Piece:
    """One aligned round of a recording (all of it if the task is done once).

    `failed` counts subtasks from the first of the round.
    """

    boundaries: tuple[BoundaryPosterior, ...]
    spans: tuple[Span, ...]
    failed: Failure | None
    evidence: float


@dataclass(frozen=True)
class Rounds:
    """The aligned rounds of each recording.

    `task` has the number of rounds that was performed (over recordings of an unknown number, the most);
    `steps` are its subtasks, in `number` rounds, or with `open_end` in at most that many.
    """

    pool: Pool
    pieces: list[list[Piece]]
    task: BlockTask
    steps: tuple[Subtask, ...]
    number: int
    open_end: bool

    def joined(
        self, index: int, file: str, last: float, rate: float, recorded: Signals | None = None
    ) -> tuple[Segmentation, tuple[BoundaryPosterior, ...], np.ndarray]:
        """Join the rounds of one recording that ends at `last` [s], of this median `rate` [Hz].

        Returns its segmentation, all boundary posteriors, and which of `steps` it shows (num_subtasks,).
        """
        pieces, steps, number = self.pieces[index], self.steps, self.number
        per_round = (len(steps) - 1) // number
        boundaries = [b for piece in pieces[:number] for b in piece.boundaries]
        boundaries += [point_mass(last)] * (len(steps) - 1 - len(boundaries))
        present = np.zeros(len(steps), bool)
        failures, spans = [], list[Span]()

        def fail(step: Subtask, reason: str, repetition: int) -> None:
            failures.append(Failure(step.index, step.name, step.object, reason, repetition))

        for r, piece in enumerate(pieces[:number]):
            base, stop = r * per_round, per_round if piece.failed is None else piece.failed.index
            present[base : base + stop + (piece.failed is None)] = True
            spans = _continued(spans, piece.spans)
            if piece.failed is not None:
                at_step, repetition = base + piece.failed.index, r + 1 if number > 1 else None
                failures.append(replace(piece.failed, index=at_step, repetition=repetition))
        if len(pieces) > number:
            grip = pieces[number].boundaries[0].quantile(0.5)
            reason = f"the recording goes on after the task's end with another grip at {grip:.2f} s"
            fail(steps[-1], reason, number + 1)
        elif len(pieces) < number and not self.open_end:
            fail(steps[len(pieces) * per_round + 1], "the recording ends before it", len(pieces) + 1)
        segmentation = Segmentation(
            file, rate, sum(p.evidence for p in pieces), tuple(spans), failures[0] if failures else None,
            len(pieces) if number > 1 or self.open_end else None, tuple(failures), recorded,
            self.pool.remarks,
        )  # fmt: skip
        return segmentation, tuple(boundaries), present


def _continued(before: list[Span], after: Sequence[Span]) -> list[Span]:
    """Append the spans of the next round; the free motion between two rounds is a single release."""
    if before and after and before[-1].state == FREE and after[0].state == FREE:
        free = replace(before[-1], end=after[0].end, end_sd=after[0].end_sd, end_90=after[0].end_90)
        return [*before[:-1], free, *after[1:]]
    return [*before, *after]


def aligned_rounds(
    recordings: Sequence[Recorded],
    coarse: Sequence[Features],
    task: BlockTask,
    rig: Rig,
    all_fit: bool = False,
) -> Rounds:
    """Find and align the rounds of all recordings.

    `coarse`: features of each thinned recording. `all_fit`: assume that all conform to the task.
    """
    if task.repeat == 1 or all_fit:
        samples = [[slice(0, r.t.size)] for r in recordings]
        verdicts = [[v] for v in examine(coarse, [task] * len(recordings))]
    else:
        samples, verdicts = _rounds(recordings, coarse, task, rig)
    steps = subtasks(task if all_fit else one_round(task))
    parts = [(r, p) for r, own in zip(recordings, samples, strict=True) for p in own]
    flat = [v for own in verdicts for v in own]
    fitting = [i for i, verdict in enumerate(flat) if all_fit or verdict.failing is None]
    taps = [v.free.taps for v in flat]
    if fitting:
        pool = pooled(parts, fitting, steps, rig, taps)
    else:  # nothing but nominal sensors
        parameters = flat[0].free.parameters
        readings = [_read(part(r, p), rig, t) for (r, p), t in zip(parts, taps, strict=True)]
        pool = Pool(readings, Fit(parameters, ()), sense([], [], (), parameters, rig))
    fitted = dict(zip(fitting, zip(pool.fit.posteriors, pool.changes, strict=True), strict=True))
    aligned = []
    for i, (reading, verdict) in enumerate(zip(pool.readings, flat, strict=True)):
        if i not in fitted:
            aligned.append(_departed(reading, steps, verdict, pool))
            continue
        alignment, changes = fitted[i]
        boundaries = boundary_posteriors(reading, changes, pool.discrepancy, alignment)
        spans = to_spans(steps, boundaries, *reading.ends)
        aligned.append(Piece(boundaries, spans, None, float(alignment.log_evidence)))
    in_order = iter(aligned)
    pieces = [[next(in_order) for _ in own] for own in samples]
    most = max(len(own) for own in pieces) if task.repeat == "unknown" else task.repeat
    done = replace(task, repeat=most)
    open_end = task.repeat == "unknown"
    return Rounds(pool, pieces, done, subtasks(done), 1 if all_fit else most, open_end)


def _rounds(
    recordings: Sequence[Recorded], coarse: Sequence[Features], task: BlockTask, rig: Rig
) -> tuple[list[list[slice]], list[list[Conformity]]]:
    """Samples and verdict of every round of every recording."""
    cuts = [find_cuts(f, task) for f in coarse]
    while True:
        samples = [slices(r.t, at) for r, at in zip(recordings, cuts, strict=True)]
        parts = [[features(thin(part(r, p)), rig) for p in own]
                 for r, own in zip(recordings, samples, strict=True)]  # fmt: skip
        tasks = [own for p in parts for own in round_tasks(task, len(p))]
        judged = iter(examine([f for own in parts for f in own], tasks))
        verdicts = [[next(judged) for _ in own] for own in parts]
        merged = False
        for i, own in enumerate(verdicts):
            if task.repeat != "unknown" and len(own) > task.repeat:
                k = merge_point(own, [f.t for f in parts[i]])
                if k is not None:
                    del cuts[i][k]
                    merged = True
        if not merged:
            return samples, verdicts


def _departed(reading: Reading, steps: tuple[Subtask, ...], verdict: Conformity, pool: Pool) -> Piece:
    """Align a misfit with the order that it shows instead of its task's."""
    assert verdict.failing is not None
    shown = plan(verdict, steps)
    boundaries, evidence = (), verdict.log_evidence
    if any(s.state != FREE for s in shown.steps):
        own = fit([reading.features], shown.steps, shown.start)
        alignment = own.posteriors[0]
        evidence = float(alignment.log_evidence)
        changes = contact_changes(reading, pool.sensing, shown.steps, own.parameters, alignment)
        boundaries = boundary_posteriors(reading, changes, pool.discrepancy, alignment)
    spans = to_spans(shown.steps, boundaries, *reading.ends)
    reason = explain(verdict, steps, [span.start for span in spans])
    step = steps[verdict.failing]
    return Piece(
        task_boundaries(shown, boundaries, len(steps), *reading.ends),
        (*spans[: shown.num_before], *spans[len(spans) - shown.num_after :]),
        Failure(step.index, step.name, step.object, reason),
        evidence,
    )


@dataclass(frozen=True, repr=False)
class TrialAlignment(Brief):
    """One aligned trial for later stages: the trial, its signals and boundary posteriors.

    `signals` are the recording's; `thinned` and `features` those that the emissions score. `present`
    (num_subtasks,): which subtasks it shows as the task describes them.
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
    """All trials of one task; those that conform are aligned by one joint fit.

    `fit` pools the conforming trials, or rounds of a repeated task, in order; with none it has no posteriors.
    `late`: forces lag behind positions because of their sensor.
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
        """Plot one trial's signals over its coloured subtasks; returns the axes. Saved if a path is given."""
        return self.segmentations[trial].plot(path)


def align(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    all_fit: bool = False,
    signals: Sequence[Signals] | None = None,
) -> AlignedTrials:
    """Fit the switching model to the trials jointly, and align each of them.

    A trial that does not fit its task is excluded from the joint fit and aligned with the order that it shows
    instead: its subtasks before `failed` are the task's, later boundaries are not. Its log evidence is that
    of the order shown. Each round of a repeated task is such a trial, so a failing round leaves the others
    intact.

    Args:
        trials: recordings of one hand, at least one.
        task: the order they follow.
        rig: the nominal hand.
        all_fit: assume that all trials conform, whatever they show.
        signals: one per trial, read instead of its own.

    Returns:
        The aligned trials; `task` has its number of rounds (over recordings of an unknown number, the most).
    """
    if signals is None:
        signals = [timely(task_space(trial, rig), trial) for trial in trials]
    whole = [with_heights(s, trial, rig) for s, trial in zip(signals, trials, strict=True)]
    rounds = aligned_rounds(signals, [features(thin(s), rig) for s in whole], task, rig, all_fit)
    aligned = []
    for i, (trial, s) in enumerate(zip(trials, signals, strict=True)):
        rate = float(1.0 / np.median(np.diff(s.t)))
        segmentation, boundaries, present = rounds.joined(i, trial.file, float(s.t[-1]), rate, s)
        thinned = thin(s, window=WINDOW)
        aligned.append(
            TrialAlignment(trial, s, thinned, features(thinned, rig), boundaries, segmentation, present)
        )
    pool = rounds.pool
    return AlignedTrials(rounds.task, rig, rounds.steps, pool.fit, tuple(aligned), pool.late)


def segment(trials: Sequence[Trial], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segmentation of each trial of one task; all are fitted together."""
    return align(trials, task, rig).segmentations


def segment_long(recording: LongRecording, task: BlockTask, rig: Rig) -> Segmentation:
    """Segment one recording that stays on disk, as `segment` does.

    Reads it twice: thinned as a whole to find the rounds, then round by round. Memory holds the times, and
    the signals at 100 Hz at most.
    """
    source = OnDisk(recording, rig)
    rounds = aligned_rounds([source], [features(source.thinned(), rig)], task, rig)
    return rounds.joined(0, recording.file, float(recording.t[-1]), recording.rate)[0]
