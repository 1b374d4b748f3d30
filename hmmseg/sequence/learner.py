"""EM over all trials of a plain ordered task."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from hmmseg.hmm.alignment import Alignment, align_many
from hmmseg.sequence.detectors import Detectors
from hmmseg.sequence.emissions import (
    StudentEmissions,
    from_weights,
    independent_share,
    residuals,
    update,
)
from hmmseg.sequence.model import weights
from hmmseg.sequence.transitions import transitions

FLOORS = (1.0, 0.5, 0.25, 0.12, 0.06)  # numerics: least scale of an emission, lowered as EM settles
STEPS_PER_FLOOR = 4  # numerics: of EM
PRESENCE_PRIOR = (1.0, 1.0)  # chosen: Beta prior of an optional state's presence


class Learner:
    """EM over `values` [(num_cells, num_features), ...] of all trials.

    `names` of the task's states and `optional` (num_states,) say what may follow what. What labels say of
    each trial may be set: `known`, its path (num_cells,), which then stays as it is; `allowed`
    (num_cells, num_states), -inf where a state is forbidden and 0 elsewhere. None where they say nothing.
    """

    def __init__(
        self,
        values: Sequence[np.ndarray],
        names: Sequence[str],
        optional: Sequence[bool],
    ) -> None:
        self.values = list(values)
        self.stacked = np.vstack(self.values)
        self.optional = list(optional)
        self.known: list[np.ndarray | None] = [None] * len(self.values)
        self.allowed: list[np.ndarray | None] = [None] * len(self.values)
        self.num_states = len(self.optional)
        # A name listed twice is one state that comes twice: its emissions are learned together.
        self.same = np.eye(self.num_states)
        for i, j in itertools.product(range(len(names)), repeat=2):
            self.same[i, j] = names[i] == names[j]

    def pooled(self, probability: Sequence[np.ndarray]) -> np.ndarray:
        """State probabilities of all cells, those of equally named states added up."""
        return np.vstack(probability) @ self.same

    def durations(self, probability: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Mean durations [cells] and presence of every state, from posterior state probabilities."""
        visited = np.array([p.max(0) for p in probability])
        presence = (visited.sum(0) + PRESENCE_PRIOR[0]) / (len(probability) + sum(PRESENCE_PRIOR))
        cells = np.sum([p.sum(0) for p in probability], 0) / np.maximum(visited.sum(0), 0.5)
        return np.maximum(cells, 1.5), presence

    def align(self, emissions: StudentEmissions, probability: Sequence[np.ndarray],
              detectors: Detectors | None = None, labels: bool = True) -> list[Alignment]:  # fmt: skip
        """Alignments of all trials; `labels` False: as if nothing were known of them."""
        law = transitions(*self.durations(probability), self.optional)
        parts = [weights(v, emissions, detectors, law.bands) for v in self.values]
        tables = [
            p[0] if allowed is None or not labels else p[0] + allowed
            for p, allowed in zip(parts, self.allowed, strict=True)
        ]
        return align_many(tables, [p[1] for p in parts], log_initial=law.log_initial, log_final=law.log_final)

    def run(
        self,
        probability: Sequence[np.ndarray],
        temper: float,
        floors: Sequence[float] = FLOORS,
        detectors: Detectors | None = None,
        steps: int = STEPS_PER_FLOOR,
    ) -> tuple[StudentEmissions, list[np.ndarray], float]:
        """EM from given state probabilities; also those it ends with and the summed log evidence."""
        probability = list(probability)
        emissions = from_weights(self.stacked, self.pooled(probability), floors[0], temper)
        aligned: list[Alignment] = []
        for floor in floors:
            for _ in range(steps):
                aligned = self.align(emissions, probability, detectors)
                probability = [
                    a.smoothed if path is None else np.eye(self.num_states)[path]
                    for a, path in zip(aligned, self.known, strict=True)
                ]
                emissions = update(emissions, self.stacked, self.pooled(probability), floor)
        return emissions, probability, sum(a.log_evidence for a in aligned)

    def one_hot(self, paths: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Paths as state probabilities."""
        return [np.eye(self.num_states)[path] for path in paths]

    def independent_share(self, emissions: StudentEmissions, probability: Sequence[np.ndarray]) -> float:
        """Share of independent observations in what the emissions leave of the features."""
        paths = [p.argmax(1) for p in probability]
        return independent_share(
            [residuals(emissions, v, p) for v, p in zip(self.values, paths, strict=True)]
        )
