"""Courses: ways to align unlabelled trials, and which of their changes are the boundaries that a task names.

A course is an ordered model of more stretches than the task has states; stretch k is the same in all trials.
Each starts from an optimal partition of one trial (dynamic programming, Jackson et al., IEEE Signal Process.
Lett. 12, 2005, with a Gaussian cost per stretch), whose stretches initialise the other trials. Where trials
can be aligned in several ways, courses differ, and none of them shows how far to trust it: all are kept.

The posterior that a named boundary is a given change of a course sums over all choices exactly (forward and
backward over the changes, as Fearnhead, Stat. Comput. 16, 2006, over samples). An unnamed settled state may
follow the last named one.

The emission model is wrong in ways that all samples share, so evidence must not grow with their number: a
coarsened posterior (Miller and Dunson, J. Am. Stat. Assoc. 114, 2019) counts all samples as at most
`independent` observations.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from hmmseg.sequence.emissions import FLOORS, Learner
from hmmseg.sequence.features import fill_gaps

MAX_BLOCKS = 250  # numerics: the cost table is quadratic in this


def partition(
    values: np.ndarray, num_stretches: int, floor: float, cuts: Sequence[int] | np.ndarray = ()
) -> np.ndarray:
    """Path (num_cells,) of stretch numbers 0 .. num_stretches - 1 with the least total cost, n/2 log(variance
    + floor^2) of a stretch of n blocks per column of the finite `values` (num_cells, num_features); none
    crosses the cells `cuts`. ValueError for fewer cells than stretches."""
    num_cells = len(values)
    if num_cells < num_stretches:
        raise ValueError(f"{num_cells} cells, expected at least {num_stretches}")
    edges = np.linspace(0, num_cells, min(num_cells, MAX_BLOCKS) + 1).round().astype(int)
    edges = np.unique(np.concatenate([edges, np.asarray(cuts, int)]))
    means = np.add.reduceat(values, edges[:-1], axis=0) / np.diff(edges)[:, None]
    means = means - means.mean(0)
    cost = pooled_costs(np.ones(len(means)), means, means**2, floor)
    for at in np.searchsorted(edges, cuts):
        cost[:at, at + 1 :] = np.inf
    best, sources = cost[0].copy(), []
    for _ in range(num_stretches - 1):
        total = best[:, None] + cost
        sources.append(total.argmin(0))
        best = total.min(0)
    found, end = [], len(means)
    for source in reversed(sources):
        end = int(source[end])
        found.append(edges[end])
    return np.searchsorted(np.array(found[::-1]), np.arange(num_cells), side="right")


def pooled_costs(count: np.ndarray, first: np.ndarray, second: np.ndarray, floor: float) -> np.ndarray:
    """Cost [a, b] (N + 1, N + 1) of merging the parts a <= k < b into one stretch, inf for an empty one.
    `count` (N,): cells in each part; `first`, `second` (N, num_features): sums of values and of squares."""
    n, x, x2 = (np.concatenate([np.zeros((1, *v.shape[1:])), np.cumsum(v, axis=0)])
                for v in (count.astype(float), first, second))  # fmt: skip
    number = n[None] - n[:, None]
    safe, cost = np.where(number > 0, number, 1.0), np.zeros_like(number)
    for s1, s2 in zip(x.T, x2.T, strict=True):
        mean = (s1[None] - s1[:, None]) / safe
        variance = np.maximum((s2[None] - s2[:, None]) / safe - mean**2, 0.0)
        cost += np.maximum(number, 0.0) / 2 * np.log(variance + floor**2)
    return np.where(np.tri(len(n), dtype=bool), np.inf, cost)


COARSE_CELLS = 300  # numerics: cells per trial on the grid on which courses are learned
MULTIPLES = (2, 3)  # chosen: stretches per named state, plus one
START_FLOORS = (0.1, 0.4)  # numerics: scale floors of the single-trial partitions from which EM starts
TEACHERS = 4  # numerics: trials whose partition is tried as a start for all trials
SAME = 0.005  # numerics: share of a trial; courses whose changes are this close are duplicates
MERGE_FLOOR = 0.4  # chosen: least scale of a merged stretch, so that quiet channels do not dominate


@dataclass(frozen=True)
class Course:
    """One alignment of all trials."""

    probability: list[np.ndarray]  # [(num_cells, num_stretches), ...] of each stretch, on the coarse grid
    ends: np.ndarray  # (num_trials, num_stretches - 1) of stretches as shares of the trial
    cost: np.ndarray  # [a, b] (num_stretches + 1, ...) [nats] of a <= k < b as one state, all cells counted
    share: float  # independent observations per cell, from the residuals
    seen: np.ndarray  # (num_stretches - 1,) log probability that a change is real, not one level cut in two

    @property
    def observations(self) -> float:
        """Number of independent observations in all trials."""
        return self.share * sum(len(p) for p in self.probability)


def find_courses(values: Sequence[np.ndarray], num_states: int, labels: Sequence[np.ndarray]) -> list[Course]:
    """Distinct courses of trials `values` [(num_cells, num_features), ...] on a coarse grid. `labels` as in
    `naming`; labelled trials are tried first as starts, with stretches that end at the labels."""
    most = max(num_states, min(map(len, values)) // 2)
    numbers = dict.fromkeys(min(m * num_states + 1, most) for m in MULTIPLES)
    labelled = [i for i, known in enumerate(labels) if np.isfinite(known).any()]
    spread = np.linspace(0, len(values) - 1, min(TEACHERS, len(values))).round().astype(int)
    teachers = list(dict.fromkeys([*labelled, *spread.tolist()]))[:TEACHERS]
    found: list[Course] = []
    for number, i, floor in itertools.product(numbers, teachers, START_FLOORS):
        course = _learn_course(values, number, i, floor, labels[i])
        same = [other for other in found if other.ends.shape == course.ends.shape]
        if not any(np.abs(other.ends - course.ends).max(initial=0.0) < SAME for other in same):
            found.append(course)
    return found


def _learn_course(
    values: Sequence[np.ndarray], number: int, teacher: int, floor: float, known: np.ndarray
) -> Course:
    """EM from the optimal partition of trial `teacher`, with `known` boundaries, into `number` stretches."""
    names, features = [f"{k}" for k in range(number)], values[0].shape[1]
    temper = 1 / features  # during EM a cell counts as one observation
    cells = len(values[teacher])
    cuts = np.unique(np.clip((known[np.isfinite(known)] * cells).round().astype(int), 1, cells - 1))
    path = partition(np.arcsinh(fill_gaps(values[teacher])), number, floor, cuts)
    alone = Learner([values[teacher]], names, [False] * number)
    initial, start = alone.run([np.eye(number)[path]], temper, FLOORS[1:3], steps=1)
    paths = [path if cuts.size and i == teacher else None for i in range(len(values))]
    learner = Learner(list(values), names, [False] * number, known=paths)
    aligned = learner.align(initial, learner.law(start))
    emissions, probability = learner.run([a.smoothed for a in aligned], temper, FLOORS[2:], steps=3)
    ends = np.array([p[:, : number - 1].sum(0).cumsum() / len(p) for p in probability])
    likeliest = [p.argmax(1) for p in probability]
    one_hot, stacked = np.eye(number)[np.concatenate(likeliest)], np.vstack([fill_gaps(v) for v in values])
    x = np.arcsinh(stacked)
    cost = pooled_costs(one_hot.sum(0), one_hot.T @ x, one_hot.T @ x**2, MERGE_FLOOR) / features
    share = learner.tempered(emissions, probability).temper * features
    return Course(probability, ends, cost, share, seen(values, likeliest, number, share))


def seen(values: Sequence[np.ndarray], paths: Sequence[np.ndarray], number: int, share: float) -> np.ndarray:
    """Log probability (number - 1,) that each change is real, against one state on both sides, by `share`
    independent observations per cell and the Schwarz criterion."""
    bridged = [np.arcsinh(fill_gaps(v)) for v in values]
    stacked, path = np.vstack(bridged), np.concatenate(paths)
    features = stacked.shape[1]
    out = np.zeros(number - 1)
    for j in range(number - 1):
        laws = [stacked[np.isin(path, of)] for of in ((j,), (j + 1,), (j, j + 1))]
        if not (len(laws[0]) and len(laws[1])):
            out[j] = -np.inf
            continue
        left, right, both = ((x.mean(0), np.log(x.var(0) + FLOORS[-1] ** 2)) for x in laws)
        gain = -features / 2 * np.log(max(share * len(laws[2]), 1.0))
        for x, own in zip(bridged, paths, strict=True):
            here = x[(own == j) | (own == j + 1)]
            cost = [share / (2 * features) * (log + (here - mean) ** 2 / np.exp(log)).sum(1)
                    for mean, log in (left, right, both)]  # fmt: skip
            before, after, whole = (np.r_[0.0, c.cumsum()] for c in cost)
            changed = -before - (after[-1] - after)
            gain += np.logaddexp.reduce(changed) - np.log(changed.size) + whole[-1]
        out[j] = -np.logaddexp(0.0, -gain)
    return out


def coarsen(values: np.ndarray, factor: int) -> np.ndarray:
    """Means over `factor` neighbouring cells (NaN if none has a value)."""
    known = np.isfinite(values)
    starts = np.arange(0, len(values), factor)
    count = np.add.reduceat(known.astype(float), starts, axis=0)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


LEAST_SHARE = 1e-3  # numerics: share of a trial; shorter durations count as this in the logarithm
NEAR = 0.02  # chosen: share of a trial within which two boundaries are the same


@dataclass(frozen=True)
class Weighing:
    """Prior weights of choices, learned on sequences of many kinds (`experiments.sequences learn`)."""

    independent: float  # number of observations to which evidence is coarsened
    settled: float  # log odds of an unnamed state after the last event
    shares: float  # exponent of the share of the trial that each state but the last takes
    lag: float  # scale of the Laplace law of boundaries about their change, as a share of the trial
    labelled: float  # the same where labels tell the mean lag
    elsewhere: float  # probability that a boundary is at no change at all
    unseen: float  # prior weight of a change that the channels do not show, relative to one that they do


WEIGHING = Weighing(  # learned: by `experiments.sequences learn --worlds 40`
    independent=80.4, settled=-3.84, shares=0.035, lag=0.0074, labelled=0.005, elsewhere=0.009, unseen=0.015
)


@dataclass(frozen=True)
class Naming:
    """Which changes of one course are the named boundaries."""

    log_evidence: float  # [nats] averaged over all choices
    probability: np.ndarray  # (num_boundaries, num_changes) that boundary b is change j
    settled: np.ndarray  # (num_changes,) that a settled state begins at change j


@dataclass(frozen=True)
class Choice:
    """Changes of one course chosen as its task's boundaries."""

    course: int  # its index
    ends: tuple[int, ...]  # changes, from 1, that end the named states, the last one only if settled
    settled: bool  # whether a settled state follows the last named one
    right: np.ndarray  # (num_boundaries,) probability that each is within NEAR of the chosen change


def naming(
    course: Course, num_states: int, labels: Sequence[np.ndarray], weighing: Weighing = WEIGHING
) -> Naming:
    """Sum over all choices of `num_states` - 1 >= 1 boundaries among the changes of a course. `labels`
    [(num_states - 1,), ...]: known boundaries of each trial as shares of it, NaN where unknown."""
    # Log weights: groups [a, b] of stretches a <= k < b as one named state; tail [a] of those from a on as
    # the last one, and end [a, e] with a settled state from e on; change of a change that ends a state.
    temper = weighing.independent * course.share / (weighing.independent + course.observations)
    evidence = np.where(np.isfinite(course.cost), -temper * course.cost, -np.inf)
    edges = np.column_stack([np.zeros(len(course.ends)), course.ends, np.ones(len(course.ends))])
    shares = np.maximum(edges[:, None] - edges[:, :, None], LEAST_SHARE)
    change = np.logaddexp(np.log1p(-weighing.unseen) + course.seen, np.log(weighing.unseen))
    groups = evidence + weighing.shares * np.log(shares).mean(0)
    end = evidence + evidence[:, -1] + weighing.settled + np.r_[0.0, change, 0.0]
    tail = np.logaddexp(evidence[:, -1], np.logaddexp.reduce(end, axis=1))
    at = label_weights(course, labels, weighing)
    at[:, 1:-1] += change
    ahead = [groups[0] + at[0]]
    for b in range(1, num_states - 1):
        ahead.append(np.logaddexp.reduce(ahead[-1][:, None] + groups) + at[b])
    behind = [tail]
    for b in range(num_states - 2, 0, -1):
        behind.append(np.logaddexp.reduce(groups + (behind[-1] + at[b])[None], axis=1))
    number = len(tail) - 1
    joint = np.array([one + other for one, other in zip(ahead, behind[::-1], strict=True)])[:, 1:number]
    total = float(np.logaddexp.reduce(joint[0]))
    last = np.exp(ahead[-1][:, None] + end - total)[:, 1:number].sum(0)
    choices = np.r_[0.0, np.full(num_states - 1, -np.inf)]  # log normaliser, by number of changes chosen
    for each in change:
        choices[1:] = np.logaddexp(choices[1:], choices[:-1] + each)
    return Naming(total - float(choices[-1]), np.exp(joint - total), last)


def label_weights(course: Course, labels: Sequence[np.ndarray], weighing: Weighing) -> np.ndarray:
    """Log density (num_boundaries, num_changes + 2) of the labels if boundary b is change j (from 1)."""
    out = np.zeros((len(labels[0]), course.ends.shape[1] + 2))
    for ends, known in zip(course.ends, labels, strict=True):
        for b in np.flatnonzero(np.isfinite(known)):
            density = np.exp(-np.abs(known[b] - ends) / weighing.lag) / (2 * weighing.lag)
            out[b, 1:-1] += np.log((1 - weighing.elsewhere) * density + weighing.elsewhere)
    return out


def probabilities(namings: Sequence[Naming]) -> np.ndarray:
    """Posterior probability (num_courses,) of each course."""
    return softmax([each.log_evidence for each in namings])


def best_choice(courses: Sequence[Course], namings: Sequence[Naming], probability: np.ndarray) -> Choice:
    """The choice with the greatest expected number of correct boundaries, over all courses and choices."""
    best, answer = -np.inf, None
    for i, (course, own) in enumerate(zip(courses, namings, strict=True)):
        right = np.zeros_like(own.probability)
        for weight, other, its in zip(probability, courses, namings, strict=True):
            apart = np.median(np.abs(course.ends[:, :, None] - other.ends[:, None]), axis=0)
            right += weight * its.probability @ (apart < NEAR).T
        total, cuts = _increasing(right)
        if total > best:
            later = own.settled[cuts[-1] + 1 :]
            settled = bool(later.size and own.settled.sum() > 0.5)
            ends = [j + 1 for j in cuts]
            if settled:
                ends.append(cuts[-1] + 2 + int(later.argmax()))
            best = total
            answer = Choice(i, tuple(ends), settled, right[np.arange(len(cuts)), cuts])
    assert answer is not None
    return answer


def _increasing(right: np.ndarray) -> tuple[float, list[int]]:
    """Increasing column indices, one per row of `right`, with the greatest sum, and that sum."""
    total, source = right[0], []
    for row in right[1:]:
        source.append([0, *(int(total[:j].argmax()) for j in range(1, row.size))])
        total = np.r_[-np.inf, np.maximum.accumulate(total)[:-1]] + row
    cuts = [int(total.argmax())]
    for back in reversed(source):
        cuts.append(back[cuts[-1]])
    return float(total.max()), cuts[::-1]
