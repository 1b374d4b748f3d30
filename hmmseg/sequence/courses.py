"""What recordings show: ordered models of more stretches than their task has states, from many starts.

Stretch k is the same in all trials of a course. Where trials can be aligned in several ways, courses differ,
and nothing in one of them says how far to trust it: all are kept (hmmseg.sequence.naming weighs them).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.sequence.changepoints import partition
from hmmseg.sequence.features import filled
from hmmseg.sequence.learner import FLOORS, Learner

COARSE_CELLS = 300  # numerics: a trial, on the grid on which courses are learned
MULTIPLES = (2, 3)  # chosen: stretches a named state, and one more
START_FLOORS = (0.1, 0.4)  # numerics: of the partitions of single trials from which EM starts
TEACHERS = 4  # numerics: trials whose partition is a start for all trials
SAME = 0.005  # numerics: of a trial: courses whose changes are as close are one
MERGE_FLOOR = 0.4  # chosen: least scale of a merged stretch: a quiet channel says no more than the others


@dataclass(frozen=True)
class Course:
    """One way to align all trials.

    `probability` [(num_cells, num_stretches), ...]: of stretches, on the coarse grid. `ends` (num_trials,
    num_stretches - 1): where they end, as shares of the trial. `cost` [a, b] (num_stretches + 1, ...): of
    stretches a <= k < b as one state, nats as if each cell were one independent observation. `share`: of
    independent observations in what the stretches leave.
    """

    probability: list[np.ndarray]
    ends: np.ndarray
    cost: np.ndarray
    share: float

    @property
    def observations(self) -> float:
        """Independent observations in all trials."""
        return self.share * sum(len(p) for p in self.probability)


def find_courses(values: Sequence[np.ndarray], num_states: int, labels: Sequence[np.ndarray]) -> list[Course]:
    """Courses of trials `values` [(num_cells, num_features), ...] on a coarse grid, all different.

    `labels` [(num_states - 1,), ...]: known boundaries as shares of each trial, NaN where unknown. Labelled
    trials teach first, and their stretches end where the labels are.
    """
    most = max(num_states, min(map(len, values)) // 2)
    found: list[Course] = []
    for number in dict.fromkeys(min(m * num_states + 1, most) for m in MULTIPLES):
        for i in _teachers(len(values), labels):
            for floor in START_FLOORS:
                course = _taught(values, number, i, floor, labels[i])
                if not any(_alike(course, other) for other in found):
                    found.append(course)
    return found


def _teachers(count: int, labels: Sequence[np.ndarray]) -> list[int]:
    """Labelled trials, then others spread evenly."""
    first = [i for i, known in enumerate(labels) if np.isfinite(known).any()]
    spread = np.unique(np.linspace(0, count - 1, min(TEACHERS, count)).round().astype(int)).tolist()
    return list(dict.fromkeys([*first, *spread]))[:TEACHERS]


def _taught(
    values: Sequence[np.ndarray], number: int, teacher: int, floor: float, known: np.ndarray
) -> Course:
    """The course that starts from the optimal partition of one trial, whose stretches teach the others."""
    names, features = [f"{k}" for k in range(number)], values[0].shape[1]
    temper = 1 / features  # while learning, a cell counts as one observation
    learner = Learner(values, names, [False] * number)
    cells = len(values[teacher])
    cuts = np.unique(np.clip((known[np.isfinite(known)] * cells).round().astype(int), 1, cells - 1))
    path = partition(np.arcsinh(filled(values[teacher])), number, floor, cuts)
    alone = Learner([values[teacher]], names, [False] * number)
    taught, start = alone.run(alone.one_hot([path]), temper, FLOORS[1:3], steps=1)
    if cuts.size:
        learner.known[teacher] = path
    aligned = learner.align(taught, learner.law(start))
    emissions, probability = learner.run(
        [a.smoothed for a in aligned], temper, FLOORS[2:], steps=3)  # fmt: skip
    ends = np.array([p[:, : number - 1].sum(0).cumsum() / len(p) for p in probability])
    cost = merged_costs(values, [p.argmax(1) for p in probability], number, MERGE_FLOOR) / features
    return Course(probability, ends, cost, learner.independent_share(emissions, probability) * features)


def _alike(one: Course, other: Course) -> bool:
    if one.ends.shape != other.ends.shape:
        return False
    return bool(np.abs(one.ends - other.ends).max(initial=0.0) < SAME)


def coarse(values: np.ndarray, factor: int) -> np.ndarray:
    """Means over `factor` neighbouring cells; a mean without a cell is NaN."""
    known = np.isfinite(values)
    starts = np.arange(0, len(values), factor)
    count = np.add.reduceat(known.astype(float), starts, axis=0)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def merged_costs(
    values: Sequence[np.ndarray], paths: Sequence[np.ndarray], number: int, floor: float
) -> np.ndarray:
    """Cost [a, b] (number + 1, number + 1) of stretches a <= k < b as one state, pooled over trials."""
    stacked = np.arcsinh(np.vstack([filled(v) for v in values]))
    path = np.concatenate(paths)
    one_hot = np.eye(number)[path]
    pad = np.zeros((1, stacked.shape[1]))
    count = np.concatenate([[0.0], np.cumsum(one_hot.sum(0))])
    first = np.concatenate([pad, np.cumsum(one_hot.T @ stacked, 0)])
    second = np.concatenate([pad, np.cumsum(one_hot.T @ stacked**2, 0)])
    n = count[None] - count[:, None]
    safe = np.where(n > 0, n, 1.0)[..., None]
    mean = (first[None] - first[:, None]) / safe
    variance = np.maximum((second[None] - second[:, None]) / safe - mean**2, 0.0)
    cost = np.maximum(n, 0) / 2 * np.log(variance + floor**2).sum(-1)
    return np.where(np.arange(number + 1)[None] > np.arange(number + 1)[:, None], cost, np.inf)
