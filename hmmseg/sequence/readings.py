"""Which of the changes that recordings show are the boundaries that the task names?

A task names K states; its recordings often show more changes than K - 1 (a state has phases of its own,
something settles after the last event). First, what they show: an ordered model of more states than the
task has, whose stretches are the same in all trials. Then a reading says which of its changes are
boundaries. For every boundary and every change where it may lie, the best reading that puts it there is
learned by EM on a coarse grid.

How probable a reading is: emissions are wrong in ways that all samples of all trials share, so evidence must
not grow with their number. It is that of a coarsened posterior (Miller and Dunson, J. Am. Stat. Assoc. 114,
2019): samples count as if they were `independent` ones, however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.sequence.changepoints import partition
from hmmseg.sequence.features import filled
from hmmseg.sequence.learner import FLOORS, Learner

COARSE_CELLS = 300  # numerics: a trial, on the grid on which readings are compared
START_FLOORS = (0.1, 0.4)  # numerics: of the partitions of single trials from which EM starts
TEACHERS = 4  # numerics: trials whose partition is a start for all trials
MOST = 24  # numerics: readings that are learned, with and without a settled state
SAME = 0.01  # chosen: of a trial: readings whose boundaries are as close are one
MERGE_FLOOR = 0.1  # numerics: least scale of a merged stretch
LEAST_SHARE = 1e-3  # numerics: of a trial, for a duration's logarithm
NEAR = 0.02  # chosen: of a trial: how far from what the channels show a label may be
FORGIVING = 1e-3  # chosen: weight of a reading that puts a labelled boundary elsewhere


@dataclass(frozen=True)
class Weighing:
    """What makes a reading probable, learned on sequences of many kinds (`make sequences`).

    `independent`: observations that evidence counts as in the limit of many. `settled`: log odds of a
    state that nobody named after the last event. `shares`: exponent of the share of its trial that each state
    but the last takes.
    """

    independent: float
    settled: float
    shares: float


WEIGHING = Weighing(
    independent=23.8,  # learned: by `experiments.sequences learn --worlds 45`
    settled=-0.58,  # learned: by `experiments.sequences learn --worlds 45`
    shares=0.22,  # learned: by `experiments.sequences learn --worlds 45`
)


@dataclass(frozen=True)
class Reading:
    """One way to divide all trials.

    `probability` [(num_cells, num_states), ...]: of states, on the coarse grid. `settled`: whether one
    more state follows the named ones. `evidence` [nats]: as if every cell were one independent observation;
    `share`: independent observations a cell. `ends` (num_trials, num_named - 1): where the named states end,
    as shares of the trial. `labels` [nats]: agreement with what is known of some boundaries.
    """

    probability: list[np.ndarray]
    settled: bool
    evidence: float
    share: float
    ends: np.ndarray
    labels: float = 0.0


def find_readings(
    values: Sequence[np.ndarray], names: Sequence[str], optional: Sequence[bool], labels: Sequence[np.ndarray]
) -> list[Reading]:
    """Readings of trials `values` [(num_cells, num_features), ...] on a coarse grid, all different.

    `labels` [(num_names - 1,), ...]: known boundaries as shares of each trial, NaN where unknown.
    """
    number = 2 * len(names) + 1
    if min(map(len, values)) < 2 * number:
        number = len(names) + 1
    paths = stretches(values, number)
    cost = merged_costs(values, paths, number, MERGE_FLOOR)
    allowed = _allowed(paths, number, labels)
    found = []
    for settled in (False, True):
        states = len(names) + settled
        groupings = best_groupings(cost, states, allowed) or best_groupings(cost, states)
        learner = Learner(values, names, [*optional, *[True] * settled])
        learner.allowed = [
            forbidding(len(v), states, known, NEAR) for v, known in zip(values, labels, strict=True)
        ]
        for cuts in sorted(groupings, key=groupings.__getitem__)[:MOST]:
            start = [np.searchsorted(np.array(cuts) - 0.5, path) for path in paths]
            found.append(_learned(learner, start, settled, len(names), labels))
    found.sort(key=lambda reading: -reading.evidence)
    kept: list[Reading] = []
    for reading in found:
        if not any(reading.settled == o.settled and _apart(reading, o) < SAME for o in kept):
            kept.append(reading)
    return kept


def probabilities(readings: Sequence[Reading], weighing: Weighing = WEIGHING) -> np.ndarray:
    """Posterior probability (num_readings,) of each reading."""
    # One share for all: of the reading that leaves the least unexplained.
    share = max(readings, key=lambda reading: reading.evidence).share
    out = []
    for r in readings:
        observations = sum(p.shape[0] for p in r.probability)
        coarsened = weighing.independent / (weighing.independent + share * observations)
        durations = np.diff(np.column_stack([np.zeros(len(r.ends)), r.ends]), axis=1)
        log_shares = np.log(np.maximum(durations, LEAST_SHARE)).sum(1).mean()
        out.append(
            coarsened * share * r.evidence
            + weighing.settled * r.settled
            + weighing.shares * log_shares
            + r.labels
        )
    weights = np.exp(np.array(out) - max(out))
    return weights / weights.sum()


def expected_right(readings: Sequence[Reading], probability: np.ndarray) -> np.ndarray:
    """Expected share (num_readings,) of boundaries that each reading has right, were one of them true."""
    ends = np.stack([r.ends for r in readings])
    agree = (np.abs(ends[:, None] - ends[None]) < NEAR).mean((2, 3))
    return agree @ probability


def _learned(learner: Learner, start: Sequence[np.ndarray], settled: bool, named: int,
             labels: Sequence[np.ndarray]) -> Reading:  # fmt: skip
    # While learning, a cell counts as one observation.
    features = learner.stacked.shape[1]
    emissions, probability, evidence = learner.run(learner.one_hot(start), 1 / features, FLOORS[2:], steps=3)
    ends = np.array([p[:, : named - 1].sum(0).cumsum() / len(p) for p in probability])
    agreement = 0.0
    if any(np.isfinite(known).any() for known in labels):
        free = learner.align(emissions, probability, labels=False)
        for alignment, known in zip(free, labels, strict=True):
            agreement += _agreement(alignment.smoothed, known)
    share = learner.independent_share(emissions, probability) * features
    return Reading(probability, settled, evidence, share, ends, agreement)


def _agreement(smoothed: np.ndarray, known: np.ndarray) -> float:
    """Log probability that boundaries lie near their labels, were these not known."""
    total = 0.0
    position = np.arange(len(smoothed)) / len(smoothed)
    for b in np.flatnonzero(np.isfinite(known)):
        past = smoothed[:, b + 1 :].sum(1)  # probability that boundary b has come
        low, high = np.interp([known[b] - NEAR, known[b] + NEAR], position, past)
        total += float(np.log(max(high - low, 0.0) + FORGIVING))
    return total


def forbidding(cells: int, states: int, known: np.ndarray, reach: float) -> np.ndarray | None:
    """Log weights (cells, states): -inf where a label forbids a state, 0 elsewhere; None without labels.

    `known` (num_boundaries,): labelled boundaries as shares of the trial, NaN where unknown; +-`reach`.
    """
    if not np.isfinite(known).any():
        return None
    out = np.zeros((cells, states))
    middle = (np.arange(cells) + 0.5) / cells
    reach = max(reach, 1 / cells)
    for b in np.flatnonzero(np.isfinite(known)):
        out[middle < known[b] - reach, b + 1 :] = -np.inf
        out[middle > known[b] + reach, : b + 1] = -np.inf
    return out


def _allowed(paths: Sequence[np.ndarray], number: int, labels: Sequence[np.ndarray]) -> np.ndarray:
    """Whether a boundary (row) may lie at a change (column, from 1): of labelled ones, at the two nearest."""
    out = np.ones((len(labels[0]), number + 1), bool)
    for path, known in zip(paths, labels, strict=True):
        changes = np.searchsorted(path, np.arange(1, number)) / len(path)
        for b in np.flatnonzero(np.isfinite(known)):
            nearest = 1 + np.argsort(np.abs(changes - known[b]), kind="stable")[:2]
            out[b] &= np.isin(np.arange(number + 1), nearest)
    return out


def _apart(one: Reading, other: Reading) -> float:
    return float(np.median(np.abs(one.ends - other.ends), axis=0).max(initial=0.0))


def coarse(values: np.ndarray, factor: int) -> np.ndarray:
    """Means over `factor` neighbouring cells; a mean without a cell is NaN."""
    known = np.isfinite(values)
    starts = np.arange(0, len(values), factor)
    count = np.add.reduceat(known.astype(float), starts, axis=0)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def stretches(
    values: Sequence[np.ndarray], number: int, floors: Sequence[float] = FLOORS
) -> list[np.ndarray]:
    """Paths of one ordered model of so many states, of highest evidence among starts.

    Every start is the optimal partition of one trial, whose stretches then teach all others: so stretch
    k is the same in all of them.
    """
    squashed = [np.arcsinh(filled(v)) for v in values]
    chosen = np.unique(np.linspace(0, len(values) - 1, min(TEACHERS, len(values))).round().astype(int))
    learner = Learner(values, [f"{k}" for k in range(number)], [False] * number)
    temper = 1 / values[0].shape[1]
    best, highest = None, -np.inf
    for i in chosen:
        for floor in START_FLOORS:
            path = partition(squashed[i], number, floor)
            alone = Learner([values[i]], [f"{k}" for k in range(number)], [False] * number)
            taught, start, _ = alone.run(alone.one_hot([path]), temper, floors[1:3], steps=1)
            aligned = learner.align(taught, start)
            _, probability, evidence = learner.run(
                [a.smoothed for a in aligned], temper, floors[2:], steps=3)  # fmt: skip
            if evidence > highest:
                best, highest = probability, evidence
    assert best is not None
    return [p.argmax(1) for p in best]


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


def best_groupings(
    cost: np.ndarray, groups: int, allowed: np.ndarray | None = None
) -> dict[tuple[int, ...], float]:
    """For every boundary and every change where it may lie, the cheapest grouping that puts it there.

    `cost` [a, b] (number + 1, number + 1) of merging stretches a <= k < b; a grouping is its inner cuts
    (groups - 1,). `allowed` [b, at]: whether cut b may be at change `at`; later cuts may be anywhere.
    """
    number = len(cost) - 1
    if groups == 1:
        return {(): float(cost[0, number])}
    at_cut = np.zeros((groups - 1, number + 1))
    if allowed is not None:
        rows = min(len(allowed), groups - 1)
        at_cut[:rows] = np.where(allowed[:rows], 0.0, np.inf)
    # Cheapest way for the first stretches up to b in so many groups, and for those from a on.
    ahead, behind = [cost[0]], [cost[:, number]]
    for g in range(1, groups):
        ahead.append(((ahead[-1] + at_cut[g - 1])[:, None] + cost).min(0))
        behind.append((cost + (behind[-1] + at_cut[groups - 1 - g])[None]).min(1))
    found = {}
    for b in range(1, groups):  # the cut between group b - 1 and b
        for at in range(1, number):
            total = ahead[b - 1][at] + at_cut[b - 1, at] + behind[groups - b - 1][at]
            if not np.isfinite(total):
                continue
            left, end = [], at
            for g in range(b - 1, 0, -1):
                end = int((ahead[g - 1] + at_cut[g - 1] + cost[:, end]).argmin())
                left.append(end)
            right, start = [], at
            for g in range(groups - b - 1, 0, -1):
                start = int((cost[start] + behind[g - 1] + at_cut[groups - 1 - g]).argmin())
                right.append(start)
            found[(*left[::-1], at, *right)] = float(total)
    return found
