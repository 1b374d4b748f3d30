"""The paper's estimators: plain means over the subtasks (its Table 3), no optimality attempted.

- weight: mean net vertical force over the carry without its first and last 5 %
- width: mean horizontal distance of the fingers over the carry
- heights: mean height of the right finger over the pickup and over the place of each move; their
  differences are the sums of object heights that `height_equations` names, solved by least
  squares, and for a move off or onto one block the height of that block
- friction: the largest |fy1 / fx1| over pickup, carry or slide, and place; a lower bound

Samples at which no holding state is identified are left out, as the paper has it. Estimates of
several trials are averaged. The standard deviation is that of the samples (Table 4's), the
standard error that of the mean as if samples were independent; what autocorrelation, inertia
and pads do to it is not in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, UNITS, Subtask, decompose, height_equations, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import StateLabels, label_states

TRIM = 0.05  # chosen: share of the carry left out at either end of the weight estimate


@dataclass(frozen=True)
class Estimate:
    """A property: mean, standard deviation over samples and standard error of the mean."""

    unit: str
    mean: float
    sd: float
    standard_error: float
    subtasks: tuple[str, ...]

    def to_json(self) -> dict:
        """Entry of `properties`; the intervals are normal ones of the mean's standard error."""
        document: dict = {"unit": self.unit, "mean": self.mean, "sd": self.sd, "median": self.mean}
        document["standard_error"] = self.standard_error
        for percent in (68, 95):
            half = float(ndtri(0.5 + percent / 200)) * self.standard_error
            document[f"interval_{percent}"] = [self.mean - half, self.mean + half]
        return {**document, "subtasks": list(self.subtasks)}


@dataclass(frozen=True)
class FrictionBound:
    """Lower bound of the friction coefficient between fingers and object."""

    lower_bound: float
    subtasks: tuple[str, ...]

    def to_json(self) -> dict:
        """Entry of `properties`."""
        return {"unit": "1", "lower_bound": self.lower_bound, "subtasks": list(self.subtasks)}


@dataclass(frozen=True)
class PluginEstimates:
    """Per object and property an estimate, or None with the reason under "object.property"."""

    properties: dict[str, dict[str, Estimate | FrictionBound | None]]
    reasons: dict[str, str]

    def to_json(self) -> dict:
        """The `properties` and `reasons` of the JSON of `identify`."""
        shown = {name: {key: None if value is None else value.to_json() for key, value in entry.items()}
                 for name, entry in self.properties.items()}  # fmt: skip
        return {"properties": shown, "reasons": dict(self.reasons)}


@dataclass(frozen=True)
class _Mean:
    """A mean over samples with their standard deviation and its standard error."""

    mean: float
    sd: float
    error: float


@dataclass(frozen=True)
class _Trial:
    """One trial's signals, the samples identified as holding, and its spans by subtask."""

    signals: Signals
    held: np.ndarray
    spans: dict[int, tuple[float, float]]  # index of the subtask: start and end [s]

    def samples(self, subtask: int, trim: float = 0.0) -> np.ndarray:
        """Whether each sample is of the subtask and held, bool (num_timesteps,)."""
        if subtask not in self.spans:
            return np.zeros(self.held.size, dtype=bool)
        start, end = self.spans[subtask]
        cut = trim * (end - start)
        t = self.signals.t
        return self.held & (t >= start + cut) & (t < end - cut)


def estimate_plugin(
    trials_signals: Sequence[Signals],
    segmentations: Sequence[Segmentation],
    task: BlockTask,
    states: Sequence[StateLabels] | None = None,
) -> PluginEstimates:
    """The paper's estimates of every object of a task from its segmented trials.

    Args:
        trials_signals: one a trial.
        segmentations: one a trial.
        task: of all trials.
        states: contact states of each trial's samples; by default those of the paper's thresholds.

    Returns:
        Mean and standard deviation of every property, or why it has none.

    Raises:
        ValueError: the sequences differ in length.
    """
    labels = [label_states(s) for s in trials_signals] if states is None else list(states)
    task = _as_performed(task, segmentations)
    steps = subtasks(task)
    trials = [
        _Trial(signals, label.state > 1, _matched(segmentation, steps))
        for signals, segmentation, label in zip(trials_signals, segmentations, labels, strict=True)
    ]
    heights = _heights(trials, task, steps)
    known = decompose(task).properties
    properties: dict[str, dict[str, Estimate | FrictionBound | None]] = {}
    reasons: dict[str, str] = {}
    for name in task.objects:
        found = {
            "weight": _over_carries(trials, steps, name, "weight", "fy", TRIM),
            "width": _over_carries(trials, steps, name, "width", "distance", 0.0),
            "height": heights.get(name),
            "friction": _friction(trials, steps, name),
        }
        properties[name] = found
        for key, value in found.items():
            if value is None:
                shown = "no trial shows enough identified samples of the subtasks it needs"
                carried = any(s.state == ABOVE_GROUND and s.object == name for s in steps)
                if key in ("weight", "width") and not carried:
                    shown = f"no move carries {name}, and the formula averages over a carry"
                reasons[f"{name}.{key}"] = known[name][key].reason or shown
    return PluginEstimates(properties, reasons)


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


def _mean(values: np.ndarray) -> _Mean | None:
    """Mean of the samples that are there; None of fewer than two, whose scatter is unknown."""
    values = values[np.isfinite(values)]
    if values.size < 2:
        return None
    sd = float(np.std(values, ddof=1))
    return _Mean(float(np.mean(values)), sd, sd / math.sqrt(values.size))


def _pooled(means: Sequence[_Mean], unit: str, names: Sequence[str]) -> Estimate | None:
    """Mean over the means, each with the same weight."""
    if not means:
        return None
    sd = math.sqrt(np.mean([m.sd**2 for m in means]))
    error = math.sqrt(sum(m.error**2 for m in means)) / len(means)
    return Estimate(unit, float(np.mean([m.mean for m in means])), sd, error, tuple(dict.fromkeys(names)))


def _over_carries(
    trials: Sequence[_Trial], steps: tuple[Subtask, ...], name: str, key: str, signal: str, trim: float
) -> Estimate | None:
    carries = [s for s in steps if s.state == ABOVE_GROUND and s.object == name]
    found = [(_mean(getattr(trial.signals, signal)[trial.samples(s.index, trim)]), s.label)
             for trial in trials for s in carries]  # fmt: skip
    return _pooled([mean for mean, _ in found if mean], UNITS[key], [label for mean, label in found if mean])


def _heights(
    trials: Sequence[_Trial], task: BlockTask, steps: tuple[Subtask, ...]
) -> dict[str, Estimate | None]:
    """Height of every object that some trial determines."""
    equations = [(move, rise) for move, rise in height_equations(task) if rise]
    by_name: dict[str, list[_Mean]] = {name: [] for name in task.objects}
    used: dict[str, list[str]] = {name: [] for name in task.objects}
    for trial in trials:
        rows, rises, measured = [], [], []
        for move, rise in equations:
            difference = _rise(trial, steps, move)
            if difference is not None:
                rows.append([rise.get(name, 0) for name in task.objects])
                rises.append(difference)
                measured.append(move)
        if not rows:
            continue
        matrix = np.array(rows, dtype=float)
        inverse = np.linalg.pinv(matrix)
        determined = np.isclose(inverse @ matrix, np.eye(len(task.objects)), atol=1e-9).all(axis=1)
        for name, weights in zip(np.array(task.objects)[determined], inverse[determined], strict=True):
            by_name[name].append(_combined(weights, rises))
            moves = {move for move, weight in zip(measured, weights, strict=True) if abs(weight) > 1e-9}
            used[name] += [s.label for s in _ends(steps, moves)]
    return {name: _pooled(by_name[name], UNITS["height"], used[name]) for name in task.objects}


def _combined(weights: np.ndarray, rises: Sequence[_Mean]) -> _Mean:
    """Weighted sum of independent means; its absolute value, as Table 3 has it."""
    mean, sd, error = np.array([(m.mean, m.sd, m.error) for m in rises]).T
    return _Mean(abs(float(weights @ mean)), float(np.hypot.reduce(weights * sd)),
                 float(np.hypot.reduce(weights * error)))  # fmt: skip


def _ends(steps: tuple[Subtask, ...], moves: set[int]) -> list[Subtask]:
    return [s for s in steps if s.move in moves and s.name in ("pickup", "place")]


def _rise(trial: _Trial, steps: tuple[Subtask, ...], move: int) -> _Mean | None:
    """Mean y2 over a move's place less that over its pickup."""
    pickup, place = (_mean(trial.signals.y2[trial.samples(s.index)]) for s in _ends(steps, {move}))
    if pickup is None or place is None:
        return None
    sd, error = math.hypot(place.sd, pickup.sd), math.hypot(place.error, pickup.error)
    return _Mean(place.mean - pickup.mean, sd, error)


def _friction(trials: Sequence[_Trial], steps: tuple[Subtask, ...], name: str) -> FrictionBound | None:
    grips = [s for s in steps if s.state != FREE and s.object == name]
    best, names = -math.inf, []
    for trial in trials:
        for step in grips:
            chosen = trial.samples(step.index) & (trial.signals.fx1 > 0)
            ratio = np.abs(trial.signals.fy1[chosen] / trial.signals.fx1[chosen])
            if np.isfinite(ratio).any():
                best = max(best, float(np.nanmax(ratio)))
                names.append(f"{step.name} {name}")
    return FrictionBound(best, tuple(dict.fromkeys(names))) if names else None
