"""Where a boundary lies when trials can be read in several ways, and which label would decide.

Every reading gives a boundary its own posterior; together, weighted by the readings' probabilities, they
are what is known. Readings whose intervals overlap name the same place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.segmentation.spans import Place, Question, Segmentation

LISTED = 0.05  # chosen: least probability of a place that is told
SURE = 0.95  # chosen: from here on one place is the answer and no other is told


def mixed(probability: np.ndarray, crossings: Sequence[np.ndarray]) -> np.ndarray:
    """Crossing probabilities (num_cells - 1, num_boundaries) over all readings."""
    return np.tensordot(probability, np.stack(crossings), 1)


def places(
    medians: Sequence[float], intervals: Sequence[tuple[float, float]], probability: Sequence[float]
) -> tuple[Place, ...]:
    """Places [s] of one boundary, most probable first; none where one of them is sure.

    `medians`, `intervals` and `probability` of each reading. A place has the median of its most probable
    reading.
    """
    left = sorted(range(len(medians)), key=lambda i: -probability[i])
    found = []
    while left:
        low, high = intervals[left[0]]
        same = [i for i in left if intervals[i][0] <= high and intervals[i][1] >= low]
        found.append(Place(float(medians[left[0]]), float(sum(probability[i] for i in same))))
        left = [i for i in left if i not in same]
    found.sort(key=lambda place: -place.probability)
    if not found or found[0].probability >= SURE:
        return ()
    return tuple(place for place in found if place.probability >= LISTED)


def gains(probability: np.ndarray, crossings: Sequence[np.ndarray]) -> np.ndarray:
    """Expected reduction (num_boundaries,) [nats] of the readings' entropy by a label of each boundary.

    The mutual information of reading and label: what the mixture's entropy exceeds the readings' own by.
    """
    table = np.stack(crossings)
    table = table / np.maximum(table.sum(1, keepdims=True), np.finfo(float).tiny)
    together = np.tensordot(probability, table, 1)
    own = np.tensordot(probability, -_xlogx(table).sum(1), 1)
    return np.maximum(-_xlogx(together).sum(0) - own, 0.0)


def most_telling(segmentations: Sequence[Segmentation]) -> Question | None:
    """The one label, over all trials, that would decide most; None where nothing is open."""
    questions = [s.question for s in segmentations if s.question is not None]
    return max(questions, key=lambda question: question.gain, default=None)


def _xlogx(p: np.ndarray) -> np.ndarray:
    return np.where(p > 0, p * np.log(np.where(p > 0, p, 1.0)), 0.0)
