"""Segment trials of a block task: fit, forced alignment, boundary posteriors, fit to the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, subtasks
from hmmseg.hand.rates import timely
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.boundaries import BoundaryPosterior
from hmmseg.segmentation.conformity import MAX_RATE, Conformity, judge
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.features import WINDOW, features, thin
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.misfit import Plan, at, explain, plan, spread
from hmmseg.segmentation.pooling import Pool, Reading, pooled, unfitted
from hmmseg.segmentation.posteriors import boundary_posteriors, contact_changes, to_spans
from hmmseg.segmentation.rounds import cut, merge_point, one_round, part, round_tasks, slices
from hmmseg.segmentation.spans import Failure, Segmentation, Span
from hmmseg.segmentation.standing import standing
from hmmseg.segmentation.tables import trials_table
from hmmseg.tables import as_html, as_text


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
class AlignedTrials:
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

    def __repr__(self) -> str:
        return as_text(trials_table(self.segmentations))

    def _repr_html_(self) -> str:
        return as_html(trials_table(self.segmentations))


@dataclass(frozen=True)
class _Piece:
    """One round of one recording (of a task done once: all of it), aligned.

    `first`, `last` [s] are its ends; `failed` counts subtasks from its own first.
    """

    boundaries: tuple[BoundaryPosterior, ...]
    spans: tuple[Span, ...]
    failed: Failure | None
    evidence: float
    first: float
    last: float


def align(
    trials: Sequence[Trial],
    task: BlockTask,
    rig: Rig,
    insist: bool = False,
    signals: Sequence[Signals] | None = None,
) -> AlignedTrials:
    """Fit the switching model to the trials, pooled, and align each of them.

    A trial that does not fit its task is kept out of the pool and aligned with the order that it
    shows instead: its subtasks before `failed` are the task's, boundaries after it are not. Its
    log evidence is that of the order it shows. `insist`: all are taken to fit, whatever they show.

    Of a repeated task every round is such a trial: one that fails leaves the others as they are. `task`
    of the result has its number of rounds (of several recordings with an unknown number, the most).
    `signals`: to be read instead of the trials' own.
    """
    if signals is None:
        signals = [timely(task_space(trial, rig), trial, rig) for trial in trials]
    judged = [features(thin(s, MAX_RATE), rig) for s in signals]
    if task.repeat == 1 or insist:
        every = [[slice(0, s.t.size)] for s in signals]
        verdicts = [[v] for v in judge(judged, [task] * len(signals))]
    else:
        every, verdicts = _rounds(signals, judged, task, rig)
    steps = subtasks(task if insist else one_round(task))
    flat = [part(s, p) for s, own in zip(signals, every, strict=True) for p in own]
    of = [v for own in verdicts for v in own]
    fitting = [i for i, verdict in enumerate(of) if insist or verdict.failing is None]
    parameters = of[0].free.parameters
    taps = [v.free.taps for v in of]
    pool = pooled(flat, fitting, steps, rig, taps) if fitting else unfitted(flat, parameters, rig, taps)
    pieces = iter([
        _aligned(reading, steps, pool, fitting.index(i)) if i in set(fitting)
        else _departed(reading, steps, of[i], pool)
        for i, reading in enumerate(pool.readings)
    ])  # fmt: skip
    joined = [[next(pieces) for _ in own] for own in every]
    number = task.repeat if task.repeat != "unknown" else max(len(own) for own in joined)
    performed = replace(task, repeat=number)
    every_step = subtasks(performed)
    return AlignedTrials(performed, rig, every_step, pool.fit, tuple(
        _joined(trial, s, own, every_step, 1 if insist else number, task.repeat == "unknown", rig,
                pool.remarks)
        for trial, s, own in zip(trials, signals, joined, strict=True)
    ))  # fmt: skip


def _rounds(
    signals: Sequence[Signals], judged: Sequence[Features], task: BlockTask, rig: Rig
) -> tuple[list[list[slice]], list[list[Conformity]]]:
    """Samples and verdict of every round of every recording."""
    cuts = [cut(f, task) for f in judged]
    while True:
        every = [slices(s.t, at) for s, at in zip(signals, cuts, strict=True)]
        parts = [[features(thin(part(s, p), MAX_RATE), rig) for p in own]
                 for s, own in zip(signals, every, strict=True)]  # fmt: skip
        tasks = [own for p in parts for own in round_tasks(task, len(p))]
        found = iter(judge([f for own in parts for f in own], tasks))
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


def _aligned(reading: Reading, steps: tuple[Subtask, ...], pool: Pool, j: int) -> _Piece:
    alignment, t = pool.fit.posteriors[j], reading.thinned.t
    boundaries = boundary_posteriors(pool.changes[j], pool.disagreement, t, alignment, reading.fine.touches)
    evidence = float(alignment.log_evidence)
    return _Piece(boundaries, to_spans(steps, boundaries, *reading.ends), None, evidence, *reading.ends)


def _departed(reading: Reading, steps: tuple[Subtask, ...], verdict: Conformity, pool: Pool) -> _Piece:
    """A trial aligned with the order that it shows in place of its task's."""
    assert verdict.failing is not None
    shown = plan(verdict, steps)
    own, evidence = _fit_shown(reading.features, shown, verdict)
    found = ()
    if own is not None:
        alignment = own.posteriors[0]
        changes = contact_changes(
            reading.fine, reading.thinned, pool.sensing, shown.steps, own.parameters, alignment
        )
        found = boundary_posteriors(
            changes, pool.disagreement, reading.thinned.t, alignment, reading.fine.touches
        )
    ends = reading.ends
    boundaries = spread(shown, found, len(steps), *ends)
    every = to_spans(shown.steps, found, *ends)
    spans = (*every[: shown.num_before], *every[len(every) - shown.num_after :])
    step = steps[verdict.failing]
    reason = explain(verdict, steps, [span.start for span in every], _stands(reading.thinned, every))
    return _Piece(boundaries, spans, Failure(step.index, step.name, step.object, reason), evidence, *ends)


def _stands(s: Signals, spans: Sequence[Span]) -> np.ndarray:
    """Times [s] at which a finger stands on something."""
    free = np.zeros(s.t.size, bool)
    for span in spans:
        free |= (span.state == FREE) & (s.t >= span.start) & (s.t < span.end)
    return s.t[standing(s, free)]


def _joined(
    trial: Trial, signals: Signals, pieces: Sequence[_Piece], steps: tuple[Subtask, ...], number: int,
    open_end: bool, rig: Rig, remarks: tuple[str, ...],
) -> TrialAlignment:  # fmt: skip
    """One recording from its rounds, `number` of them by its task (`open_end`: at most)."""
    thinned = thin(signals, window=WINDOW)
    per_round = (len(steps) - 1) // number
    last = float(signals.t[-1])
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
    rate = float(1.0 / np.median(np.diff(signals.t)))
    segmentation = Segmentation(
        trial.file, rate, sum(p.evidence for p in pieces), tuple(spans), failures[0] if failures else None,
        len(pieces) if number > 1 or open_end else None, tuple(failures), signals, remarks,
    )  # fmt: skip
    table = features(thinned, rig)
    return TrialAlignment(trial, signals, thinned, table, tuple(boundaries), segmentation, present)


def _continued(before: list[Span], after: Sequence[Span]) -> list[Span]:
    """Spans of the rounds so far and of the next; the free motion between them is one release."""
    if before and after and before[-1].state == FREE and after[0].state == FREE:
        free = replace(before[-1], end=after[0].end, end_sd=after[0].end_sd, end_90=after[0].end_90)
        return [*before[:-1], free, *after[1:]]
    return [*before, *after]


def _fit_shown(f: Features, shown: Plan, verdict: Conformity) -> tuple[Fit | None, float]:
    """Fit of one trial to the order it shows, and its log evidence; no fit where nothing is held."""
    if all(s.state == FREE for s in shown.steps):
        return None, verdict.log_evidence
    own = fit([f], shown.steps, shown.start)
    return own, float(own.posteriors[0].log_evidence)


def segment(trials: Sequence[Trial], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segmentation of each trial of one task; all are fitted together."""
    return align(trials, task, rig).segmentations
