"""The qualitative segmentation: thresholds, contact states by rules, subtasks by their order.

The rival of the switching model, after Dupont, Schulteis, Millman and Howe (1999), Section 3.3
and Table 2. Signals become tri-valued by symmetric thresholds; rules on those values name the
contact state of every sample (0 where no rule holds); the known order of the subtasks turns
states into spans: of all assignments in that order, the one that agrees with most samples. Where several do,
the one that holds on the ground longer: net upward force under a weight that still rests shows as
hold-above-ground, which the rules cannot tell apart.
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
from hmmseg.segmentation.spans import Failure, Segmentation, Span

FORCE_THRESHOLD = 0.05  # cited: N
VELOCITY_THRESHOLD = 0.05  # cited: m/s
NUMBERS = {FREE: 1, ABOVE_GROUND: 2, ON_GROUND: 3, SLIDING: 3}  # cited: the paper's; 0 is none of them
JUMP = 0.05  # chosen: share of all samples by which going on behind a missing subtask must agree better


@dataclass(frozen=True)
class StateLabels:
    """Contact state of every sample, in the paper's numbering.

    `state` (num_timesteps,) int: 0 none, 1 free motion, 2 hold above ground, 3 hold on ground;
    `sliding` (num_timesteps,) bool marks the samples of 3 that slide.
    """

    state: np.ndarray
    sliding: np.ndarray


@dataclass(frozen=True)
class Assignment:
    """Samples of every subtask: first and last (num_subtasks,), -1 where it has none.

    `agreement` is the share of samples whose state is that of the subtask they lie in.
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
    """Tri-valued function of a signal: +1, 0 or -1 against +-level; NaN where it is missing."""
    sign = np.where(values > level, 1.0, np.where(values < -level, -1.0, 0.0))
    return np.where(np.isnan(values), np.nan, sign)


def label_states(
    signals: Signals,
    force_threshold: float = FORCE_THRESHOLD,
    velocity_threshold: float = VELOCITY_THRESHOLD,
) -> StateLabels:
    """Contact state of every sample by the rules of the paper's Table 2.

    Thresholds in N and m/s. Free motion: both force components of both fingers are 0. Hold on
    ground: grip +, net vertical force - or 0, mean vertical velocity 0; sliding where moreover
    the mean horizontal velocity is not 0. Hold above ground: grip + and net vertical force +. A
    sample that lacks a signal its rule asks for is 0. InputError for a threshold that is not > 0.
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
    columns = []
    for step in steps:
        column = labels.state == NUMBERS[step.state]
        if step.state == SLIDING:
            column = column & labels.sliding
        elif step.state == ON_GROUND and step.move in slid:
            column = column & ~labels.sliding
        columns.append(column)
    return np.stack(columns, axis=1)


def monotone_order(labels: StateLabels, steps: tuple[Subtask, ...]) -> Assignment:
    """The assignment in order that agrees with most samples, by dynamic programming.

    Every subtask gets a sample that agrees with it if that is possible at all. Otherwise the order
    ends early or passes over subtasks, the latter only if 5 % of all samples agree more for it:
    flicker between states must not pass for the subtasks of a later move.
    """
    agrees = agreement(labels, steps)
    on_ground = np.array([step.state == ON_GROUND for step in steps])
    # Agreement decides; the 1 breaks ties in favour of holding on the ground.
    score = agrees * (labels.state.size + 1) + ((labels.state == 2)[:, None] & on_ground)
    entries = _best_entries(agrees, score, may_skip=False)
    if entries is None:
        entries = _best_entries(agrees, score, may_skip=True) or {}
    return _trimmed(agrees, entries)


def _best_entries(agrees: np.ndarray, score: np.ndarray, may_skip: bool) -> dict[int, int] | None:
    """First sample of every subtask on the best path {subtask: sample}; None if there is no path.

    A subtask may only be entered at a sample that agrees with it, which loses nothing: leading
    samples that disagree serve the subtask before as well. best[s][t] is the score of the best
    path with the samples before t assigned and subtask s the last; the samples before the first
    subtask's entry score nothing.
    """
    length, count = agrees.shape
    total = np.vstack([np.zeros(count), np.cumsum(score, axis=0)])  # (length + 1, count)
    origin, toll = np.zeros(length), JUMP * length * (length + 1)
    best, entered, come_from = [], [], []
    for s in range(count):
        sources = [origin if not s else best[s - 1][:-1]]
        names = [s - 1]
        if may_skip and s:
            jumps = [b[:-1] - toll for b in (np.append(origin, 0.0), *best[:-1])]
            sources, names = [*sources, *jumps], [s - 1, *range(-1, s - 1)]
        stacked = np.stack(sources)
        chosen = np.argmax(stacked, axis=0)
        gain = np.where(agrees[:, s], stacked.max(axis=0) - total[:-1, s], -np.inf)
        running = np.maximum.accumulate(gain)
        best.append(np.concatenate([[-np.inf], running + total[1:, s]]))
        entered.append(_last_rise(running))
        come_from.append(np.asarray(names)[chosen])
    s = int(np.argmax([b[-1] for b in best])) if may_skip else count - 1
    if not np.isfinite(best[s][-1]):
        return None
    entries, end = {}, length
    while s >= 0:
        entry = int(entered[s][end - 1])
        entries[s] = entry
        s, end = int(come_from[s][entry]), entry
    return entries


def _last_rise(running: np.ndarray) -> np.ndarray:
    """Index at which a running maximum last rose, for every sample."""
    rises = np.concatenate([[False], running[1:] > running[:-1]])
    return np.maximum.accumulate(np.where(rises, np.arange(running.size), 0))


def _trimmed(agrees: np.ndarray, entries: dict[int, int]) -> Assignment:
    """Subtasks from their entry to their last sample that agrees."""
    length, count = agrees.shape
    first, last, hits = np.full(count, -1), np.full(count, -1), 0
    order = sorted(entries)
    for i, s in enumerate(order):
        end = entries[order[i + 1]] if i + 1 < len(order) else length
        inside = np.flatnonzero(agrees[entries[s] : end, s]) + entries[s]
        first[s], last[s], hits = inside[0], inside[-1], hits + inside.size
    return Assignment(first, last, hits / length)


def segment_qualitative(
    trial: Trial,
    signals: Signals,
    task: AnyTask,
    force_threshold: float = FORCE_THRESHOLD,
    velocity_threshold: float = VELOCITY_THRESHOLD,
    order: Order = monotone_order,
) -> Segmentation:
    """Segmentation of one trial by thresholds, rules and the order of the subtasks.

    A boundary lies anywhere between the last sample of one subtask and the first of the next:
    its median is the midpoint, its deviation and interval those of a uniform. There is no
    evidence. A subtask without samples fails the trial; the others keep their spans.

    Args:
        trial: the recording.
        signals: its signals in task space.
        task: a task of blocks; one with `repeat = "unknown"` is repeated as often as agrees best.
        force_threshold: below which a force counts as none [N].
        velocity_threshold: below which a velocity counts as none [m/s].
        order: how the states of samples become subtasks in order.

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
    """Subtasks and assignment; an unknown number of repeats grows as long as it agrees better."""
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
    sd = width / math.sqrt(12)
    interval = [(float(m - 0.45 * w), float(m + 0.45 * w)) for m, w in zip(middle, width, strict=True)]
    return tuple(
        Span(steps[s].name, steps[s].object, steps[s].state, float(middle[i]), float(middle[i + 1]),
             float(sd[i]), float(sd[i + 1]), interval[i], interval[i + 1])
        for i, s in enumerate(shown)
    )  # fmt: skip
