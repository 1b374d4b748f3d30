"""Segment trials of a block task: fit, forced alignment, boundary posteriors, fit to the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, subtasks
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.boundaries import BoundaryPosterior, combine
from hmmseg.segmentation.conformity import MAX_RATE, Conformity, judge
from hmmseg.segmentation.crossings import NEAREST, Contacts, contacts
from hmmseg.segmentation.emissions import Features
from hmmseg.segmentation.features import WINDOW, features, thin
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.misfit import Plan, explain, plan, spread
from hmmseg.segmentation.spans import Failure, Segmentation, Span

INTERVAL = (0.05, 0.95)


@dataclass(frozen=True)
class TrialAlignment:
    """What later stages need of one aligned trial: the trial, its signals and boundary posteriors.

    `signals` are the recording's, `thinned` and `features` those that the emissions score.
    """

    trial: Trial
    signals: Signals
    thinned: Signals
    features: Features
    boundaries: tuple[BoundaryPosterior, ...]
    segmentation: Segmentation


@dataclass(frozen=True)
class AlignedTrials:
    """All trials of one task; those that fit it are aligned together by one fit.

    `fit` pools the trials without `failed`, in order; without any it has no posteriors.
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
    log evidence is that of the order it shows. `task` of the result has its number of rounds. `insist`: all
    are taken to fit, whatever they show. `signals`: to be read instead of the trials' own.
    """
    signals = [task_space(trial, rig) for trial in trials] if signals is None else signals
    thinned = [thin(s, window=WINDOW) for s in signals]
    tables = [features(s, rig) for s in thinned]
    task, verdicts = judge([features(thin(s, MAX_RATE), rig) for s in signals], task)
    steps = subtasks(task)
    fitting = [i for i, verdict in enumerate(verdicts) if insist or verdict.failing is None]
    pooled = fit([tables[i] for i in fitting], steps) if fitting else _unfitted(verdicts)
    aligned = []
    for i, (trial, s, f) in enumerate(zip(trials, thinned, tables, strict=True)):
        first, last = float(signals[i].t[0]), float(signals[i].t[-1])
        verdict, failed = verdicts[i], None
        if insist or verdict.failing is None:
            j = fitting.index(i)
            boundaries = boundary_posteriors(s, rig, steps, pooled, j)
            evidence = float(pooled.posteriors[j].log_evidence)
            spans = to_spans(steps, boundaries, first, last)
        else:
            shown = plan(verdict, steps)
            own, evidence = _fit_shown(f, shown, verdict)
            found = boundary_posteriors(s, rig, shown.steps, own, 0) if own else ()
            boundaries = spread(shown, found, len(steps), first, last)
            every = to_spans(shown.steps, found, first, last)
            spans = (*every[: shown.num_before], *every[len(every) - shown.num_after :])
            step = steps[verdict.failing]
            reason = explain(verdict, steps, [span.start for span in every])
            failed = Failure(step.index, step.name, step.object, reason)
        rate = float(1.0 / np.median(np.diff(signals[i].t)))
        found = Segmentation(trial.file, rate, evidence, spans, failed)
        aligned.append(TrialAlignment(trial, signals[i], s, f, boundaries, found))
    return AlignedTrials(task, rig, steps, pooled, tuple(aligned))


def _fit_shown(f: Features, shown: Plan, verdict: Conformity) -> tuple[Fit | None, float]:
    """Fit of one trial to the order it shows, and its log evidence; no fit where nothing is held."""
    if all(s.state == FREE for s in shown.steps):
        return None, verdict.log_evidence
    own = fit([f], shown.steps, shown.start)
    return own, float(own.posteriors[0].log_evidence)


def _unfitted(verdicts: Sequence[Conformity]) -> Fit:
    """Where no trial fits the task: what the first shows of the sensors, and no alignment."""
    return Fit(verdicts[0].free.parameters, ())


def boundary_posteriors(
    signals: Signals, rig: Rig, steps: tuple[Subtask, ...], fitted: Fit, trial: int
) -> tuple[BoundaryPosterior, ...]:
    """Posterior of each of the boundaries between subtasks of one trial."""
    posterior = fitted.posteriors[trial]
    table = contacts(signals, rig, fitted.parameters)
    path = np.asarray(posterior.log_smoothed).argmax(axis=1)
    out = []
    for k in range(len(steps) - 1):
        probability = np.exp(posterior.log_advance[:, k])
        densities = {}
        for n in np.flatnonzero(probability > 1e-3):
            held = _held_side(path, steps, k, int(n))
            density = _density(table, steps[k], steps[k + 1], int(n), held)
            if density is not None:
                densities[int(n)] = density
        out.append(combine(signals.t, probability, densities))
    return tuple(out)


def _density(table: Contacts, before: Subtask, after: Subtask, n: int, held: slice) -> np.ndarray | None:
    return table.density(before, after, n, held) if held.stop > held.start else None


def _held_side(path: np.ndarray, steps: tuple[Subtask, ...], k: int, n: int) -> slice:
    """The samples nearest to interval n of the subtask that rests on the ground beside it."""
    after = steps[k].state == FREE or steps[k + 1].name == "place"
    if after:
        end = np.flatnonzero(path == k + 1)
        stop = int(end[-1]) + 1 if end.size else n + 2
        return slice(n + 1, min(n + 1 + NEAREST, max(stop, n + 2)))
    begin = np.flatnonzero(path == k)
    start = int(begin[0]) if begin.size else n
    return slice(max(n + 1 - NEAREST, min(start, n)), n + 1)


def to_spans(
    steps: tuple[Subtask, ...], boundaries: tuple[BoundaryPosterior, ...], first: float, last: float
) -> tuple[Span, ...]:
    """Spans between boundary medians, kept in order."""
    medians = np.maximum.accumulate([first, *(b.quantile(0.5) for b in boundaries), last])
    sds = [0.0, *(b.sd for b in boundaries), 0.0]
    intervals = [(first, first), *(tuple(b.quantile(q) for q in INTERVAL) for b in boundaries), (last, last)]
    return tuple(
        Span(s.name, s.object, s.state, float(medians[i]), float(medians[i + 1]),
             sds[i], sds[i + 1], intervals[i], intervals[i + 1])
        for i, s in enumerate(steps)
    )  # fmt: skip


def segment(trials: Sequence[Trial], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segmentation of each trial of one task; all are fitted together."""
    return align(trials, task, rig).segmentations
