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


def find_courses(
    values: Sequence[np.ndarray], num_states: int, labels: Sequence[np.ndarray]
) -> tuple[list[Course], Course | None]:
    """Courses of trials `values` [(num_cells, num_features), ...] on a coarse grid, all different.

    `labels` [(num_states - 1,), ...]: known boundaries as shares of each trial, NaN where unknown. Labelled
    trials teach first, and their stretches end where the labels are. Beside them the best fit of as many
    stretches as are named, where the recordings show no more.
    """
    most = max(num_states, min(map(len, values)) // 2)
    numbers = dict.fromkeys((num_states, *(min(m * num_states + 1, most) for m in MULTIPLES)))
    starts = [(number, i, floor) for number in numbers for i in _teachers(len(values), labels)
              for floor in START_FLOORS]  # fmt: skip
    taught = [_taught(values, number, i, floor, labels[i]) for number, i, floor in starts]
    share = float(np.median([share for _, share in taught]))
    price = _price(values, share)

    def cost(stretches: list[np.ndarray]) -> float:
        return float(np.diagonal(_costs(values, stretches, FLOORS[-1]), 1).sum()) * share

    shown = [merged(values, probability, share, price, 1) for probability, _ in taught]
    count = min(shown, key=lambda each: cost(each) + price * each[0].shape[1])[0].shape[1]
    exact = None
    if count <= num_states:  # no change shows but those that are named
        every = [(merged(values, probability, share, price, num_states), own) for probability, own in taught]
        exact = _course(values, *min(every, key=lambda each: cost(each[0])))
    found: list[Course] = []
    for probability, own in taught:
        course = _course(values, probability, own)
        wide = probability[0].shape[1] > num_states or num_states == most
        if wide and not any(_alike(course, other) for other in found):
            found.append(course)
    return found, exact


def _teachers(count: int, labels: Sequence[np.ndarray]) -> list[int]:
    """Labelled trials, then others spread evenly."""
    first = [i for i, known in enumerate(labels) if np.isfinite(known).any()]
    spread = np.unique(np.linspace(0, count - 1, min(TEACHERS, count)).round().astype(int)).tolist()
    return list(dict.fromkeys([*first, *spread]))[:TEACHERS]


def _taught(values: Sequence[np.ndarray], number: int, teacher: int, floor: float, known: np.ndarray
            ) -> tuple[list[np.ndarray], float]:  # fmt: skip
    """Stretches that start from the optimal partition of one trial and teach the others; their `share`."""
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
    return probability, learner.independent_share(emissions, probability) * features


def _course(values: Sequence[np.ndarray], probability: list[np.ndarray], share: float) -> Course:
    number = probability[0].shape[1]
    ends = np.array([p[:, : number - 1].sum(0).cumsum() / len(p) for p in probability])
    return Course(probability, ends, _costs(values, probability, MERGE_FLOOR), share)


def _costs(values: Sequence[np.ndarray], probability: Sequence[np.ndarray], floor: float) -> np.ndarray:
    number, features = probability[0].shape[1], values[0].shape[1]
    return merged_costs(values, [p.argmax(1) for p in probability], number, floor) / features


def _price(values: Sequence[np.ndarray], share: float) -> float:
    """What a change has to gain [nats]: a mean and a spread of each feature, and a place sought in each trial
    (Schwarz, Ann. Stat. 6, 1978); a cell holds `share` independent observations."""
    observations = share * sum(map(len, values))
    places = float(np.log([len(v) for v in values]).sum())
    return values[0].shape[1] * float(np.log(max(observations, 1.0))) + places


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


def merged(values: Sequence[np.ndarray], probability: list[np.ndarray], share: float, price: float,
           least: int) -> list[np.ndarray]:  # fmt: skip
    """Probabilities (num_cells, num_stretches) of stretches, merged where they may differ by chance.

    Neighbours stay apart that gain `price`; at least `least` stretches stay.
    """
    while (number := probability[0].shape[1]) > least:
        cost = _costs(values, probability, FLOORS[-1]) * share
        k = np.arange(number - 1)
        loss = np.nan_to_num(cost[k, k + 2] - cost[k, k + 1] - cost[k + 1, k + 2])
        weakest = int(loss.argmin())
        if loss[weakest] > price:
            break
        into = np.arange(number - 1) == weakest
        probability = [np.delete(p, weakest + 1, 1) + p[:, [weakest + 1]] * into for p in probability]
    return probability


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
