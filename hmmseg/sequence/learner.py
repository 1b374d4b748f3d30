"""EM over all trials of a plain ordered task: its emissions and durations under `hmmseg.hmm.learn`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.hmm import Chain
from hmmseg.hmm.learn import em, expectation
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.sequence.emissions import (
    Detectors,
    StudentEmissions,
    detecting,
    from_weights,
    independent_share,
    residuals,
    transitions,
    update,
)

FLOORS = (1.0, 0.5, 0.25, 0.12, 0.06)  # numerics: least scale of an emission, lowered as EM settles
STEPS_PER_FLOOR = 4  # numerics: of EM
PRESENCE_PRIOR = (1.0, 1.0)  # prior: Beta prior of an optional state's presence


class Learner:
    """EM over `values` [(num_cells, num_features), ...] of all trials.

    `names` of the task's states and `optional` (num_states,) say what may follow what. What labels say of
    each trial may be set: `known`, its path (num_cells,), which then stays as it is; `allowed`
    (num_cells, num_states), -inf where a state is forbidden and 0 elsewhere. None where they say nothing.
    """

    def __init__(self, values: Sequence[np.ndarray], names: Sequence[str], optional: Sequence[bool]) -> None:
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

    def align(
        self, emissions: StudentEmissions, law: Chain, detectors: Detectors | None = None
    ) -> tuple[AlignmentPosterior, ...]:
        """Alignments of all trials, in which no state is where labels forbid it."""
        states = _Emission(self, detectors, emissions, 0.0)
        return expectation(states, _Durations(self, detectors, law), len(self.values))

    def law(self, probability: Sequence[np.ndarray]) -> Chain:
        """How states follow each other, from posterior state probabilities."""
        return transitions(*self.durations(probability), self.optional)

    def run(
        self,
        probability: Sequence[np.ndarray],
        temper: float,
        floors: Sequence[float] = FLOORS,
        detectors: Detectors | None = None,
        steps: int = STEPS_PER_FLOOR,
    ) -> tuple[StudentEmissions, list[np.ndarray]]:
        """EM from given state probabilities, `steps` at each floor of the scales; also those it ends with."""
        first = from_weights(self.stacked, self.pooled(probability), floors[0], temper)
        emission = _Emission(self, detectors, first, floors[0])
        durations = _Durations(self, detectors, self.law(probability))
        for floor in floors:
            found = em(replace(emission, floor=floor), durations, len(self.values), max_iterations=steps)
            probability = found.responsibilities
            emission = found.emission.updated(probability)
            durations = found.durations.updated(probability)
        return emission.emissions, self.as_labelled(probability)

    def as_labelled(self, probability: Sequence[np.ndarray]) -> list[np.ndarray]:
        """State probabilities, of labelled trials those of their labels."""
        return [p if k is None else np.eye(self.num_states)[k]
                for p, k in zip(probability, self.known, strict=True)]  # fmt: skip

    def one_hot(self, paths: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Paths as state probabilities."""
        return [np.eye(self.num_states)[path] for path in paths]

    def independent_share(self, emissions: StudentEmissions, probability: Sequence[np.ndarray]) -> float:
        """Share of independent observations in what the emissions leave of the features."""
        paths = [p.argmax(1) for p in probability]
        return independent_share(
            [residuals(emissions, v, p) for v, p in zip(self.values, paths, strict=True)]
        )


@dataclass(frozen=True)
class _Emission:
    """`hmmseg.hmm.learn.Emission` of a learner's trials; scales are kept above `floor`."""

    learner: Learner
    detectors: Detectors | None
    emissions: StudentEmissions
    floor: float

    def log_likelihoods(self, trial: int) -> np.ndarray:
        allowed = self.learner.allowed[trial]
        ll = self.emissions.log_likelihoods(self.learner.values[trial])
        ll = ll if self.detectors is None else self.detectors.state_weight * ll
        return ll if allowed is None else ll + allowed

    def updated(self, responsibilities: Sequence[np.ndarray]) -> _Emission:
        pooled = self.learner.pooled(self.learner.as_labelled(responsibilities))
        return replace(self, emissions=update(self.emissions, self.learner.stacked, pooled, self.floor))


@dataclass(frozen=True)
class _Durations:
    """`hmmseg.hmm.learn.Durations` of a learner's trials; detectors make advancing depend on time."""

    learner: Learner
    detectors: Detectors | None
    law: Chain

    def chain(self, trial: int) -> Chain:
        d = self.detectors
        return self.law if d is None else detecting(self.law, d.crossing(self.learner.values[trial]))

    def updated(self, responsibilities: Sequence[np.ndarray]) -> _Durations:
        return replace(self, law=self.learner.law(self.learner.as_labelled(responsibilities)))
