"""The paper's estimators: plain means over the subtasks (its Table 3), without any claim to optimality.

- weight: mean net vertical force over the carry without its first and last 5 %
- width: mean horizontal distance of the fingers over the carry
- heights: mean height of the right finger over the pickup and over the place of each move; their
  differences are the sums of object heights that `height_equations` names, solved by least
  squares, and for a move off or onto one block the height of that block
- friction: the largest |fy1 / fx1| over pickup, carry or slide, and place; a lower bound

Samples without an identified holding state are omitted, as in the paper. Estimates of several trials are
averaged. The standard deviation is that of the samples (Table 4's), the standard error that of the mean of
independent samples; the effects of autocorrelation, inertia and pads are not included.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, UNITS, Subtask, decompose, height_equations, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import StateLabels, label_states

TRIM = 0.05  # cited: share of the carry omitted at either end in the paper's weight estimate

Properties = dict[str, dict[str, dict[str, Any] | None]]  # by object and property, as in identify's JSON

# A mean over samples, their standard deviation and the mean's standard error (3,), and the subtasks' labels.
Estimate = tuple[np.ndarray, list[str]]


@dataclass(frozen=True)
class _Trial:
    """One trial's signals, the samples identified as holding, and its spans by subtask."""

    signals: Signals
    held: np.ndarray
    spans: dict[int, tuple[float, float]]  # index of the subtask: start and end [s]

    def samples(self, step: Subtask, trim: float = 0.0) -> np.ndarray:
        """Samples of the subtask that are held (num_timesteps,), without a share `trim` at each end."""
        if step.index not in self.spans:
            return np.zeros(self.held.size, dtype=bool)
        (start, end), t = self.spans[step.index], self.signals.t
        cut = trim * (end - start)
        return self.held & (t >= start + cut) & (t < end - cut)

    def mean(self, name: str, step: Subtask, trim: float = 0.0) -> np.ndarray | None:
        """Mean of a signal over these samples, their sd and its error; None for fewer than two samples."""
        values = getattr(self.signals, name)[self.samples(step, trim)]
        values = values[np.isfinite(values)]
        if values.size < 2:
            return None
        sd = np.std(values, ddof=1)
        return np.array([np.mean(values), sd, sd / math.sqrt(values.size)])


def estimate_plugin(
    trials_signals: Sequence[Signals], segmentations: Sequence[Segmentation], task: BlockTask,
    states: Sequence[StateLabels] | None = None,
) -> tuple[Properties, dict[str, str]]:  # fmt: skip
    """The paper's estimates of every object of a task from its segmented trials.

    Args:
        trials_signals: one per trial.
        segmentations: one per trial.
        task: of all trials.
        states: contact states of each trial's samples; by default those of the paper's thresholds.

    Returns:
        Every property's entry in identify's JSON, with its `standard_error` and normal intervals; and the
        reason for each missing one, by `object.property`.

    Raises:
        ValueError: the sequences differ in length.
    """
    labels = [label_states(s) for s in trials_signals] if states is None else states
    task = _as_performed(task, segmentations)
    steps = subtasks(task)
    trials = [
        _Trial(signals, label.state > 1, _matched(segmentation, steps))
        for signals, segmentation, label in zip(trials_signals, segmentations, labels, strict=True)
    ]
    heights, described = _heights(trials, task, steps), decompose(task).properties
    properties: Properties = {}
    reasons: dict[str, str] = {}
    for name in task.objects:
        grips = [s for s in steps if s.state != FREE and s.object == name]
        carries = [s for s in grips if s.state == ABOVE_GROUND]
        properties[name] = {
            "weight": _pooled("weight", _means(trials, carries, "fy", TRIM)),
            "width": _pooled("width", _means(trials, carries, "distance", 0.0)),
            "height": _pooled("height", heights[name]),
            "friction": _friction(trials, grips),
        }
        for key in [key for key, value in properties[name].items() if value is None]:
            otherwise = "no trial shows enough identified samples of the subtasks it needs"
            if key in ("weight", "width") and not carries:
                otherwise = f"no move carries {name}, and the formula averages over a carry"
            reasons[f"{name}.{key}"] = described[name][key].reason or otherwise
    return properties, reasons


def _as_performed(task: BlockTask, segmentations: Sequence[Segmentation]) -> BlockTask:
    """The task with an unknown number of repeats taken from the longest segmentation."""
    if task.repeat != "unknown":
        return task
    moves = max((sum(s.state == FREE for s in one.spans) for one in segmentations), default=2) - 1
    return replace(task, repeat=max(1, math.ceil(moves / len(task.moves))))


def _matched(segmentation: Segmentation, steps: tuple[Subtask, ...]) -> dict[int, tuple[float, float]]:
    """Start and end of every subtask that has a span; the failed one has none."""
    failed = None if segmentation.failed is None else segmentation.failed.index
    complete = len(segmentation.spans) == len(steps)
    remaining = iter(s for s in steps if complete or s.index != failed)
    matched = {}
    for span in segmentation.spans:
        for step in remaining:
            if (step.name, step.object) == (span.subtask, span.object):
                matched[step.index] = (span.start, span.end)
                break
    return matched


def _means(trials: Sequence[_Trial], steps: Sequence[Subtask], name: str, trim: float) -> list[Estimate]:
    means = [(trial.mean(name, step, trim), [step.label]) for trial in trials for step in steps]
    return [(mean, labels) for mean, labels in means if mean is not None]


def _pooled(key: str, estimates: Sequence[Estimate]) -> dict[str, Any] | None:
    """Unweighted mean of the estimates."""
    if not estimates:
        return None
    means, sds, errors = np.array([each for each, _ in estimates]).T
    mean, error = float(means.mean()), math.sqrt(np.sum(errors**2)) / len(estimates)
    out = {"unit": UNITS[key], "mean": mean, "sd": math.sqrt(np.mean(sds**2)), "median": mean}
    for percent in (68, 95):
        half = float(ndtri(0.5 + percent / 200)) * error
        out[f"interval_{percent}"] = [mean - half, mean + half]
    labels = dict.fromkeys(label for _, labels in estimates for label in labels)
    return out | {"standard_error": error, "subtasks": list(labels)}


def _heights(
    trials: Sequence[_Trial], task: BlockTask, steps: tuple[Subtask, ...]
) -> dict[str, list[Estimate]]:
    """Height of every object (absolute, as in Table 3) in each trial that determines it, by least squares."""
    heights: dict[str, list[Estimate]] = {name: [] for name in task.objects}
    for trial in trials:
        rows, rises, labels = [], [], []
        for move, rise in height_equations(task):
            ends = [s for s in steps if s.move == move and s.name in ("pickup", "place")]
            first, last = (trial.mean("y2", s) for s in ends)
            if rise and first is not None and last is not None:
                rows.append([float(rise.get(name, 0)) for name in task.objects])
                rises.append([last[0] - first[0], *np.hypot(first[1:], last[1:])])
                labels.append([s.label for s in ends])
        if not rows:
            continue
        inverse = np.linalg.pinv(rows)
        determined = np.isclose(inverse @ rows, np.eye(len(task.objects)), atol=1e-9).all(axis=1)
        mean, *errors = np.array(rises).T
        for name, weights in zip(np.array(task.objects)[determined], inverse[determined], strict=True):
            combined = np.array([abs(weights @ mean), *(np.hypot.reduce(weights * v) for v in errors)])
            used = [own for own, weight in zip(labels, weights, strict=True) if abs(weight) > 1e-9]
            heights[name].append((combined, [label for own in used for label in own]))
    return heights


def _friction(trials: Sequence[_Trial], grips: Sequence[Subtask]) -> dict[str, Any] | None:
    """The largest ratio in any grip."""
    shown = []
    for trial in trials:
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(trial.signals.fx1 > 0, np.abs(trial.signals.fy1 / trial.signals.fx1), np.nan)
        for step in grips:
            inside = ratio[trial.samples(step) & np.isfinite(ratio)]
            shown += [(float(inside.max()), step.label)] if inside.size else []
    if not shown:
        return None
    labels = list(dict.fromkeys(label for _, label in shown))
    return {"unit": "1", "lower_bound": max(ratio for ratio, _ in shown), "subtasks": labels}
