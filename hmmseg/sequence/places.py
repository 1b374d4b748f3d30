"""Where a boundary lies when trials can be aligned and read in several ways, and which label would decide.

Every course gives each of its changes a posterior; together, weighted by the probabilities of the courses and
that the boundary is that change, they are what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.segmentation.spans import Place
from hmmseg.sequence.model import NamedCourse
from hmmseg.sequence.naming import NEAR, WEIGHING

LISTED = 0.05  # chosen: least probability of a place that is told
SURE = 0.95  # chosen: from here on one place is the answer and no other is told
FARTHEST = 8.0  # numerics: reach of a Laplace law, in its scales
LEAST = 1e-3  # numerics: probability of a naming that makes no difference


@dataclass(frozen=True)
class Boundaries:
    """`crossing` (num_cells - 1, num_boundaries): probability that each is at each edge; `gain`
    (num_boundaries,) [nats]: the expected reduction of entropy, of what is which change, by its label."""

    crossing: np.ndarray
    gain: np.ndarray


def together(crossings: Sequence[np.ndarray], courses: Sequence[NamedCourse], lag: np.ndarray) -> Boundaries:
    """Posterior over all courses, from `crossings` [(num_cells - 1, num_changes), ...] of each.

    `lag` (num_boundaries,) [cells]. The gain is the mutual information of naming and label: what the
    entropy of the mixture exceeds that of its parts by.
    """
    from scipy.ndimage import convolve1d, shift  # slow to import

    mixture, gain = [], []
    for b, scale in enumerate(lag):
        parts, weights = [], []
        for crossing, course in zip(crossings, courses, strict=True):
            weight = course.probability * course.naming[b]
            for j in np.flatnonzero(course.naming[b] > LEAST):
                moved = crossing[:, j]
                if course.shift[b, j]:
                    moved = shift(moved, course.shift[b, j], order=1)
                parts.append(moved)
                weights.append(weight[j])
        table = _normal(convolve1d(np.array(parts), _laplace(scale), axis=1, mode="constant"))
        p = np.array(weights) / np.sum(weights)
        mixed = p @ table
        gain.append(max(_entropy(mixed) - float(p @ [_entropy(part) for part in table]), 0.0))
        mixture.append((1 - WEIGHING.elsewhere) * mixed + WEIGHING.elsewhere / len(mixed))
    return Boundaries(np.array(mixture).T, np.array(gain))


def _laplace(scale: float) -> np.ndarray:
    reach = int(np.ceil(FARTHEST * scale))
    kernel = np.exp(-np.abs(np.arange(-reach, reach + 1)) / max(scale, 1e-9))
    return kernel / kernel.sum()


def _normal(table: np.ndarray) -> np.ndarray:
    return table / np.maximum(table.sum(1, keepdims=True), np.finfo(float).tiny)


def near(edges: np.ndarray, crossing: np.ndarray, time: float) -> float:
    """Probability within NEAR of `time` of a boundary: `crossing` (num_cells - 1,) at the inner `edges`."""
    here = np.abs(edges[1:-1] - time) <= NEAR * (edges[-1] - edges[0])
    return float(crossing[here].sum() / crossing.sum())


def places(edges: np.ndarray, crossing: np.ndarray, answer: float) -> tuple[Place, ...]:
    """Places [s] of one boundary, most probable first; none where one of them is sure.

    `edges` (num_cells + 1,) [s], `crossing` (num_cells - 1,) the boundary's probability at the inner ones,
    `answer` [s] the time that is given: the first place. A place is what lies within NEAR of the trial.
    """
    inner, left = edges[1:-1], crossing / crossing.sum()
    reach = NEAR * (edges[-1] - edges[0])
    low = np.searchsorted(inner, inner - reach)
    high = np.searchsorted(inner, inner + reach, side="right")
    found, time = [], answer
    while True:
        here = np.abs(inner - time) <= reach
        found.append(Place(float(time), float(left[here].sum())))
        left = np.where(here, 0.0, left)
        total = np.concatenate([[0.0], np.cumsum(left)])
        window = total[high] - total[low]
        peak = int(window.argmax())
        if window[peak] < LISTED:
            break
        middle = (total[low[peak]] + total[high[peak]]) / 2
        time = inner[np.searchsorted(total[1:], middle)]
    found.sort(key=lambda place: -place.probability)
    if found[0].probability >= SURE or len(found) == 1:
        return ()
    return tuple(place for place in found if place.probability >= LISTED)


def _entropy(p: np.ndarray) -> float:
    return float(-(p * np.log(np.where(p > 0, p, 1.0))).sum())
