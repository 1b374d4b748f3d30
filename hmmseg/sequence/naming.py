"""Which of the changes of a course are the boundaries that the task names?

Every way to choose them counts: their sum is exact, and so are the probabilities that a boundary is this
change or that (forward and backward over the changes, as Fearnhead, Stat. Comput. 16, 2006, over samples).
After the last named state something may settle that nobody named.

How probable a choice is: emissions are wrong in ways that all samples of all trials share, so evidence must
not grow with their number. It is that of a coarsened posterior (Miller and Dunson, J. Am. Stat. Assoc. 114,
2019): samples count as if they were `independent` ones, however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from hmmseg.sequence.courses import Course

LEAST_SHARE = 1e-3  # numerics: of a trial, for a duration's logarithm
NEAR = 0.02  # chosen: of a trial: boundaries as close are the same


@dataclass(frozen=True)
class Weighing:
    """What makes a choice probable, learned on sequences of many kinds (`experiments.sequences learn`).

    `independent`: observations that evidence counts as in the limit of many. `settled`: log odds of a
    state that nobody named after the last event. `shares`: exponent of the share of its trial that each state
    but the last takes. `lag`: scale of the Laplace law by which boundaries lie off the change they are, as a
    share of the trial; `told`: the same where labels have told by how much. `elsewhere`: probability that a
    boundary is at no change at all.
    """

    independent: float
    settled: float
    shares: float
    lag: float
    labelled: float
    elsewhere: float


WEIGHING = Weighing(
    independent=64.0,  # learned: by `experiments.sequences learn --worlds 70`
    settled=-2.98,  # learned: by `experiments.sequences learn --worlds 70`
    shares=0.146,  # learned: by `experiments.sequences learn --worlds 70`
    lag=0.0071,  # learned: by `experiments.sequences learn --worlds 70`
    labelled=0.0049,  # learned: by `experiments.sequences learn --worlds 70`
    elsewhere=0.047,  # learned: by `experiments.sequences learn --worlds 70`
)


@dataclass(frozen=True)
class Naming:
    """What the changes of one course are.

    `log_evidence` [nats]: of the course, all choices averaged. `probability` (num_boundaries, num_changes):
    that boundary b is change j. `settled` (num_changes,): probability that the last named state ends before
    the recording does, at change j.
    """

    log_evidence: float
    probability: np.ndarray
    settled: np.ndarray


@dataclass(frozen=True)
class Choice:
    """Changes of one course as the boundaries of its task.

    `course`: its index. `ends`: the changes, from 1 on, that end the named states; where something `settled`
    follows, the last of them ends the last state. `right` (num_boundaries,): probability that each boundary
    is within NEAR of there.
    """

    course: int
    ends: tuple[int, ...]
    settled: bool
    right: np.ndarray


def naming(
    course: Course, num_states: int, labels: Sequence[np.ndarray], weighing: Weighing = WEIGHING
) -> Naming:
    """Sum over all choices of `num_states` - 1 >= 1 boundaries among the changes of a course.

    `labels` [(num_states - 1,), ...] of each trial: known boundaries as shares of it, NaN where unknown.
    """
    groups, tail, end = _weights(course, weighing)
    at = label_weights(course, labels, weighing)
    ahead = [groups[0] + at[0]]
    for b in range(1, num_states - 1):
        ahead.append(_sum(ahead[-1][:, None] + groups, 0) + at[b])
    behind = [tail]
    for b in range(num_states - 2, 0, -1):
        behind.append(_sum(groups + (behind[-1] + at[b])[None], 1))
    number = len(tail) - 1
    joint = np.array([one + other for one, other in zip(ahead, behind[::-1], strict=True)])[:, 1:number]
    total = float(np.logaddexp.reduce(joint[0]))
    last = np.exp(ahead[-1][:, None] + end - total)[:, 1:number].sum(0)
    choices = gammaln(number) - gammaln(num_states) - gammaln(number - num_states + 1)
    return Naming(total - choices, np.exp(joint - total), last)


def _weights(course: Course, weighing: Weighing) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log weights of stretches a <= k < b as one named state [a, b], of those from a on as the last [a], and
    as the last followed by a settled one from e on [a, e]."""
    temper = weighing.independent * course.share / (weighing.independent + course.observations)
    evidence = np.where(np.isfinite(course.cost), -temper * course.cost, -np.inf)
    edges = np.column_stack([np.zeros(len(course.ends)), course.ends, np.ones(len(course.ends))])
    durations = np.maximum(edges[:, None] - edges[:, :, None], LEAST_SHARE)
    groups = evidence + weighing.shares * np.log(durations).mean(0)
    end = evidence + evidence[:, -1] + weighing.settled
    return groups, np.logaddexp(evidence[:, -1], _sum(end, 1)), end


def label_weights(course: Course, labels: Sequence[np.ndarray], weighing: Weighing) -> np.ndarray:
    """Log density (num_boundaries, num_changes + 2) of the labels, were boundary b change j (from 1 on)."""
    out = np.zeros((len(labels[0]), course.ends.shape[1] + 2))
    for ends, known in zip(course.ends, labels, strict=True):
        for b in np.flatnonzero(np.isfinite(known)):
            density = np.exp(-np.abs(known[b] - ends) / weighing.lag) / (2 * weighing.lag)
            out[b, 1:-1] += np.log((1 - weighing.elsewhere) * density + weighing.elsewhere)
    return out


def probabilities(namings: Sequence[Naming]) -> np.ndarray:
    """Posterior probability (num_courses,) of each course."""
    evidence = np.array([each.log_evidence for each in namings])
    weights = np.exp(evidence - evidence.max())
    return weights / weights.sum()


def best_choice(courses: Sequence[Course], namings: Sequence[Naming], probability: np.ndarray) -> Choice:
    """The choice with the most boundaries expected right, were one of all courses and choices true."""
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
    """Increasing columns (one a row) of `right` with the greatest sum, and that sum."""
    rows, columns = right.shape
    total, source = right[0], []
    for b in range(1, rows):
        best = np.maximum.accumulate(total)
        first = np.array([int(np.argmax(total[: j + 1])) for j in range(columns)])
        source.append(np.r_[0, first[:-1]])
        total = np.r_[-np.inf, best[:-1]] + right[b]
    at = int(total.argmax())
    cuts = [at]
    for back in reversed(source):
        at = int(back[at])
        cuts.append(at)
    return float(total.max()), cuts[::-1]


def _sum(log_weights: np.ndarray, axis: int) -> np.ndarray:
    return np.logaddexp.reduce(log_weights, axis=axis)
