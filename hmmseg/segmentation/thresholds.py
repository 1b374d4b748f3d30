"""Qualitative segmentation: thresholds, rules for contact states, and the order of the subtasks.

The rival of the switching model, after Dupont, Schulteis, Millman and Howe (1999), Section 3.3 and Table 2.
Signals become tri-valued by symmetric thresholds; rules on these values give the contact state of every
sample (0 where no rule holds). Among all assignments of samples to subtasks in the task's order, the one that
agrees with most samples gives the spans. Ties go to the longer hold on ground: under a weight that still
rests, a net upward force looks like hold above ground, which the rules cannot distinguish.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask, subtasks
from hmmseg.errors import InputError
from hmmseg.hand.signals import Signals
from hmmseg.io.task import AnyTask, BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Failure, Segmentation, Span, spans_between

FORCE_THRESHOLD = 0.05  # cited: N
VELOCITY_THRESHOLD = 0.05  # cited: m/s
NUMBERS = {FREE: 1, ABOVE_GROUND: 2, ON_GROUND: 3, SLIDING: 3}  # cited: the paper's; 0 is none of them
JUMP = 0.05  # chosen: share of all samples by which skipping a missing subtask must improve agreement


@dataclass(frozen=True)
class StateLabels:
    """Contact state of every sample, in the paper's numbering.

    `state` (num_timesteps,) int: 0 none, 1 free motion, 2 hold above ground, 3 hold on ground; `sliding`
    (num_timesteps,) bool marks the samples of 3 that slide.
    """

    state: np.ndarray
    sliding: np.ndarray


@dataclass(frozen=True)
class Assignment:
    """First and last sample of every subtask (num_subtasks,), -1 if it has none.

    `agreement`: share of samples whose state is that of their subtask.
    """

    first: np.ndarray
    last: np.ndarray
    agreement: float

    @property
    def complete(self) -> bool:
        """Whether every subtask has samples."""
        return bool((self.first >= 0).all())


Order = Callable[[StateLabels, tuple[Subtask, ...]], Assignment]


def threshold(values: np.ndarray, level: float) -> np.ndarray:
    """Tri-valued signal: +1, 0 or -1 against +-level; NaN where missing."""
    sign = np.where(values > level, 1.0, np.where(values < -level, -1.0, 0.0))
    return np.where(np.isnan(values), np.nan, sign)


def label_states(
    signals: Signals, force_threshold: float = FORCE_THRESHOLD, velocity_threshold: float = VELOCITY_THRESHOLD
) -> StateLabels:
    """Contact state of every sample by the rules of the paper's Table 2.

    Free motion: both force components of both fingers are 0. Hold on ground: grip +, net vertical force - or
    0, mean vertical velocity 0; sliding if in addition the mean horizontal velocity is not 0. Hold above
    ground: grip + and net vertical force +. A sample without a signal that its rule needs is 0.

    Thresholds in N and m/s; InputError unless they are > 0.
    """
    for name, value in (("--force-threshold", force_threshold), ("--velocity-threshold", velocity_threshold)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(name, f"found {value!r}", "a number > 0")
    force = np.stack([signals.fx1, signals.fy1, signals.fx2, signals.fy2])
    free = (threshold(force, force_threshold) == 0).all(axis=0)
    gripped = threshold(signals.grip, force_threshold) > 0
    lifted = threshold(signals.fy, force_threshold)
    on_ground = gripped & (lifted <= 0) & (threshold(signals.vy, velocity_threshold) == 0)
    state = np.select([free, gripped & (lifted > 0), on_ground], [1, 2, 3], default=0)
    sliding = on_ground & (np.abs(threshold(signals.vx, velocity_threshold)) == 1)
    return StateLabels(state, sliding)


def agreement(labels: StateLabels, steps: tuple[Subtask, ...]) -> np.ndarray:
    """Whether each sample shows each subtask's state, bool (num_timesteps, num_subtasks).

    Sliding counts as hold on ground, except next to a slide, from which it must be distinguished.
    """
    slid = {step.move for step in steps if step.state == SLIDING}
    shown = np.stack([labels.state == NUMBERS[step.state] for step in steps], axis=1)
    for k, step in enumerate(steps):
        if step.move in slid and step.state in (SLIDING, ON_GROUND):
            shown[:, k] &= labels.sliding == (step.state == SLIDING)
    return shown


def monotone_order(labels: StateLabels, steps: tuple[Subtask, ...]) -> Assignment:
    """The ordered assignment that agrees with most samples, by dynamic programming.

    If possible, every subtask gets a sample that agrees with it. Otherwise the order ends early or skips
    subtasks, the latter only if JUMP of all samples agree more for it: flicker between states must not pass
    for the subtasks of a later move.
    """
    agrees = agreement(labels, steps)
    on_ground = np.array([step.state == ON_GROUND for step in steps])
    # Agreement decides; the 1 breaks ties in favour of hold on ground.
    score = agrees * (labels.state.size + 1) + ((labels.state == 2)[:, None] & on_ground)
    entries = _best_entries(agrees, score, may_skip=False) or _best_entries(agrees, score, may_skip=True)
    length, count = agrees.shape
    first, last, hits = np.full(count, -1), np.full(count, -1), 0
    for (s, start), stop in zip(entries, [start for _, start in entries[1:]] + [length], strict=False):
        inside = np.flatnonzero(agrees[start:stop, s]) + start  # up to the last sample that agrees
        first[s], last[s], hits = inside[0], inside[-1], hits + inside.size
    return Assignment(first, last, hits / length)


def _best_entries(agrees: np.ndarray, score: np.ndarray, may_skip: bool) -> list[tuple[int, int]]:
    """Subtasks and their first samples on the best path, in order; empty if there is no path.

    A subtask may only be entered at a sample that agrees with it, without loss, as leading samples that
    disagree serve the previous subtask just as well. best[s + 1][t] is the score of the best path that
    assigns the samples before t and is in subtask s; samples before the first entry, best[0], score nothing.
    """
    length, count = agrees.shape
    total = np.vstack([np.zeros(count), np.cumsum(score, axis=0)])  # (length + 1, count)
    toll, best, entered, sources = JUMP * length * (length + 1), [np.zeros(length + 1)], [], []
    for s in range(count):
        ways = np.stack([best[s], *(b - toll for b in best[:s] if may_skip)])[:, :-1]
        sources.append(np.r_[s - 1, -1 : s - 1][ways.argmax(axis=0)])
        gain = np.where(agrees[:, s], ways.max(axis=0) - total[:-1, s], -np.inf)
        running = np.maximum.accumulate(gain)
        rises = np.r_[False, running[1:] > running[:-1]]  # the entry is where the maximum last rose
        entered.append(np.maximum.accumulate(np.where(rises, np.arange(length), 0)))
        best.append(np.r_[-np.inf, running + total[1:, s]])
    s = int(np.argmax([b[-1] for b in best[1:]])) if may_skip else count - 1
    entries, end = [], length
    while s >= 0 and np.isfinite(best[s + 1][end]):
        entry = int(entered[s][end - 1])
        entries.append((s, entry))
        s, end = int(sources[s][entry]), entry
    return entries[::-1]


def segment_qualitative(
    trial: Trial,
    signals: Signals,
    task: AnyTask,
    force_threshold: float = FORCE_THRESHOLD,
    velocity_threshold: float = VELOCITY_THRESHOLD,
    order: Order = monotone_order,
) -> Segmentation:
    """Segment one trial by thresholds, rules and the order of the subtasks.

    A boundary lies anywhere between the last sample of one subtask and the first of the next: its median is
    the midpoint, its deviation and interval those of a uniform distribution. There is no evidence. A subtask
    without samples fails the trial; the others keep their spans.

    Args:
        trial: the recording.
        signals: its signals in task space.
        task: a task of blocks; with `repeat = "unknown"` it is repeated as often as agrees best.
        force_threshold: forces below it count as none [N].
        velocity_threshold: velocities below it count as none [m/s].
        order: assigns the states of samples to the ordered subtasks.

    Returns:
        The trial's segmentation.

    Raises:
        InputError: a plain ordered task, or thresholds that are not > 0.
    """
    if not isinstance(task, BlockTask):
        raise InputError("task", "a plain ordered task has no contact states to threshold",
                         "objects and moves, or the method hmm")  # fmt: skip
    labels = label_states(signals, force_threshold, velocity_threshold)
    steps, assigned = _repeated(task, labels, order)
    failed = None
    if not assigned.complete:
        step = steps[int(np.argmax(assigned.first < 0))]
        failed = Failure(step.index, step.name, step.object,
                         f"no sample at its place in the order shows {step.state} at thresholds "
                         f"{force_threshold:g} N and {velocity_threshold:g} m/s")  # fmt: skip
    return Segmentation(
        trial.file, trial.rate, None, _spans(signals.t, steps, assigned), failed, recorded=signals
    )


def _repeated(task: BlockTask, labels: StateLabels, order: Order) -> tuple[tuple[Subtask, ...], Assignment]:
    """Subtasks and assignment; an unknown number of repeats grows while agreement improves."""
    if task.repeat != "unknown":
        steps = subtasks(task)
        return steps, order(labels, steps)
    best = subtasks(replace(task, repeat=1)), order(labels, subtasks(replace(task, repeat=1)))
    for number in range(2, labels.state.size):
        steps = subtasks(replace(task, repeat=number))
        assigned = order(labels, steps)
        if not (assigned.complete and assigned.agreement > best[1].agreement):
            break
        best = steps, assigned
    return best


def _spans(t: np.ndarray, steps: tuple[Subtask, ...], assigned: Assignment) -> tuple[Span, ...]:
    shown = np.flatnonzero(assigned.first >= 0)
    begin = [t[0], *t[assigned.last[shown[:-1]]], t[-1]]  # the interval each boundary lies in
    end = [t[0], *t[assigned.first[shown[1:]]], t[-1]]
    middle, width = np.add(begin, end) / 2, np.subtract(end, begin)
    intervals = [(m - 0.45 * w, m + 0.45 * w) for m, w in zip(middle.tolist(), width.tolist(), strict=True)]
    sds = (width / math.sqrt(12)).tolist()
    return spans_between([steps[s] for s in shown], middle.tolist(), sds, intervals)
