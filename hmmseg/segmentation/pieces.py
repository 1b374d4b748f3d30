"""Rounds of recordings (of a task done once: all of each), judged, fitted together and aligned."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, subtasks
from hmmseg.contact.equations import block_width
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.boundaries import BoundaryPosterior
from hmmseg.segmentation.conformity import MAX_RATE, Conformity, examine
from hmmseg.segmentation.emissions import Features, Parameters
from hmmseg.segmentation.features import features, thin
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.misfit import Plan, at, explain, plan, task_boundaries
from hmmseg.segmentation.pooling import Pool, Reading, pooled, unfitted
from hmmseg.segmentation.posteriors import boundary_posteriors, contact_changes, to_spans
from hmmseg.segmentation.recorded import Parts, Recorded
from hmmseg.segmentation.rounds import cut, merge_point, one_round, round_tasks, slices
from hmmseg.segmentation.spans import Failure, Segmentation, Span
from hmmseg.segmentation.standing import astride, standing


@dataclass(frozen=True)
class Piece:
    """One round of one recording (of a task done once: all of it), aligned.

    `first`, `last` [s] are its ends; `failed` counts subtasks from its own first. `remarks`: what was done
    beside the task.
    """

    boundaries: tuple[BoundaryPosterior, ...]
    spans: tuple[Span, ...]
    failed: Failure | None
    evidence: float
    first: float
    last: float
    remarks: tuple[str, ...] = ()


def aligned_rounds(
    recordings: Sequence[Recorded],
    coarse: Sequence[Features],
    task: BlockTask,
    rig: Rig,
    all_fit: bool = False,
) -> tuple[Pool, list[list[Piece]]]:
    """What all recordings show together, and the rounds of each, aligned.

    `coarse` are features of each recording at conformity's MAX_RATE. `all_fit`: all are taken to fit.
    """
    if task.repeat == 1 or all_fit:
        every = [[slice(0, r.t.size)] for r in recordings]
        verdicts = [[v] for v in examine(coarse, [task] * len(recordings))]
    else:
        every, verdicts = _rounds(recordings, coarse, task, rig)
    steps = subtasks(task if all_fit else one_round(task))
    flat = Parts([(r, p) for r, own in zip(recordings, every, strict=True) for p in own])
    of = [v for own in verdicts for v in own]
    fitting = [i for i, verdict in enumerate(of) if all_fit or verdict.failing is None]
    parameters = of[0].free.parameters
    taps = [v.free.taps for v in of]
    pool = pooled(flat, fitting, steps, rig, taps) if fitting else unfitted(flat, parameters, rig, taps)
    position = {i: j for j, i in enumerate(fitting)}
    pieces = iter([
        _aligned(reading, steps, pool, position[i]) if i in position
        else _departed(reading, steps, of[i], pool)
        for i, reading in enumerate(pool.readings)
    ])  # fmt: skip
    return pool, [[next(pieces) for _ in own] for own in every]


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
        parts = [[features(thin(r.part(p), MAX_RATE), rig) for p in own]
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


def _aligned(reading: Reading, steps: tuple[Subtask, ...], pool: Pool, j: int) -> Piece:
    alignment, t = pool.fit.posteriors[j], reading.thinned.t
    boundaries = boundary_posteriors(pool.changes[j], pool.disagreement, t, alignment, reading.fine.touches)
    evidence = float(alignment.log_evidence)
    spans = to_spans(steps, boundaries, *reading.ends)
    remarks = _closed_on_others(reading, spans, pool.fit.parameters)
    return Piece(boundaries, spans, None, evidence, *reading.ends, remarks)


def _closed_on_others(reading: Reading, spans: Sequence[Span], p: Parameters) -> tuple[str, ...]:
    """What is said of fingers that closed on something wider before they held their block."""
    s, out = reading.fine, []
    force = np.stack([s.fx1, s.fy1, s.fx2, s.fy2], axis=1) - p.bias
    press = np.stack([force[:, 0], -force[:, 2]], axis=1)
    apart = block_width(s.distance, force[:, 0], force[:, 2], reading.features.pads)
    noise = p.scale["force"] if np.isnan(s.sd_force) else s.sd_force
    for before, grip in itertools.pairwise(spans):
        width = p.width.get(str(grip.object))
        if before.state != FREE or grip.state == FREE or width is None:
            continue
        met = astride(s.t, press, apart, noise, width, grip.start)
        if met is not None:
            out.append(
                f"the fingers closed on something {1e3 * met[1]:.0f} mm wide at {met[0]:.2f} s, before they "
                f"held {grip.object}: on what it stands on, or on what the task does not name"
            )
    return tuple(out)


def _departed(reading: Reading, steps: tuple[Subtask, ...], verdict: Conformity, pool: Pool) -> Piece:
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
    boundaries = task_boundaries(shown, found, len(steps), *ends)
    every = to_spans(shown.steps, found, *ends)
    spans = (*every[: shown.num_before], *every[len(every) - shown.num_after :])
    step = steps[verdict.failing]
    reason = explain(verdict, steps, [span.start for span in every], _stands(reading.thinned, every))
    return Piece(boundaries, spans, Failure(step.index, step.name, step.object, reason), evidence, *ends)


def _stands(s: Signals, spans: Sequence[Span]) -> np.ndarray:
    """Times [s] at which a finger stands on something."""
    free = np.zeros(s.t.size, bool)
    for span in spans:
        free |= (span.state == FREE) & (s.t >= span.start) & (s.t < span.end)
    force = np.stack([s.fx1, s.fy1, s.fx2, s.fy2], axis=1)
    return s.t[standing(s.t, force, s.sd_force, free)]


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
        (*remarks, *(f"{file}: {r}" for piece in pieces for r in piece.remarks)),
    )  # fmt: skip
    return segmentation, tuple(boundaries), present


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
