"""Learn a plain ordered task from trials: EM within the forced order, from labels if there are any."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.alignment import Alignment, align_many
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence import misfit as sequence_misfit
from hmmseg.sequence.changepoints import partition
from hmmseg.sequence.detectors import Detectors
from hmmseg.sequence.emissions import (
    StudentEmissions,
    from_weights,
    independent_share,
    residuals,
    update,
)
from hmmseg.sequence.features import FeatureMap, Features, feature_map, features, filled
from hmmseg.sequence.labels import Labels, choose_detectors, labelled_path, read_labels
from hmmseg.sequence.model import SequenceModel, optional_states, weights
from hmmseg.sequence.transitions import transitions

FLOORS = (1.0, 0.5, 0.25, 0.12, 0.06)  # numerics: least scale of an emission, lowered as EM settles
STEPS_PER_FLOOR = 4  # numerics: of EM
START_FLOORS = (0.1, 0.3, 0.6)  # numerics: of the partitions from which EM starts
RANDOM_STARTS = 3  # numerics: beside the partitions
PRESENCE_PRIOR = (1.0, 1.0)  # chosen: Beta prior of an optional state's presence


def fit_sequence(
    trials: Sequence[Trial],
    task: SequenceTask,
    labels: Labels | None = None,
    seed: int = 0,
) -> SequenceModel:
    """Emissions and durations of a plain ordered task.

    `labels` maps a trial's name (with or without its suffix) to its boundaries [s], one fewer than
    subtasks; a skipped optional subtask has two equal ones. Trials without labels help too. Raises
    InputError for trials too short for the task, missing channels and labels that do not fit.
    """
    if not trials:
        raise InputError("trials", "none given", "at least one trial")
    mapping = feature_map(trials, _channels(trials, task))
    data = [features(trial, mapping) for trial in trials]
    for trial, each in zip(trials, data, strict=True):
        if len(each.values) < 2 * len(task.sequence):
            raise InputError(trial.file, f"has {len(each.values)} samples",
                             f"at least two for each of {len(task.sequence)} subtasks")  # fmt: skip
    boundaries = read_labels(trials, task, labels or {})
    if any(b is not None for b in boundaries):
        return _fit_labelled(data, task, mapping, boundaries)
    return _fit_unlabelled(data, task, mapping, np.random.default_rng(seed))


def _channels(trials: Sequence[Trial], task: SequenceTask) -> tuple[str, ...]:
    if task.channels is not None:
        return task.channels
    common = [name for name in trials[0].channels if all(name in t.channels for t in trials)]
    if not common:
        raise InputError(trials[0].file, "shares no channel with the other trials", "a common column")
    return tuple(common)


class _Learner:
    """EM over all trials; `known` (num_cells,) paths of labelled trials stay as they are."""

    def __init__(
        self,
        data: list[Features],
        names: Sequence[str],
        optional: list[bool],
        known: list[np.ndarray | None],
    ) -> None:
        self.values = [each.values for each in data]
        self.stacked = np.vstack(self.values)
        self.optional, self.known = optional, known
        self.num_states = len(optional)
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

    def expect(self, emissions: StudentEmissions, probability: Sequence[np.ndarray],
               detectors: Detectors | None = None) -> tuple[list[np.ndarray], list[Alignment]]:  # fmt: skip
        """E-step: state probabilities and alignments of all trials."""
        law = transitions(*self.durations(probability), self.optional)
        parts = [weights(v, emissions, detectors, law.bands) for v in self.values]
        aligned = align_many([p[0] for p in parts], [p[1] for p in parts],
                             log_initial=law.log_initial, log_final=law.log_final)  # fmt: skip
        return [
            np.exp(a.log_smoothed) if path is None else np.eye(self.num_states)[path]
            for a, path in zip(aligned, self.known, strict=True)
        ], aligned

    def run(
        self,
        paths: list[np.ndarray],
        temper: float,
        floors: Sequence[float] = FLOORS,
        detectors: Detectors | None = None,
    ) -> tuple[StudentEmissions, list[np.ndarray], float]:
        """EM from given paths; also the state probabilities and the summed log evidence."""
        probability = [np.eye(self.num_states)[path] for path in paths]
        emissions = from_weights(self.stacked, self.pooled(probability), floors[0], temper)
        aligned: list[Alignment] = []
        for floor in floors:
            for _ in range(STEPS_PER_FLOOR):
                probability, aligned = self.expect(emissions, probability, detectors)
                emissions = update(emissions, self.stacked, self.pooled(probability), floor)
        return emissions, probability, sum(a.log_evidence for a in aligned)

    def independent_share(self, emissions: StudentEmissions, probability: list[np.ndarray]) -> float:
        paths = [p.argmax(1) for p in probability]
        return independent_share(
            [residuals(emissions, v, p) for v, p in zip(self.values, paths, strict=True)]
        )


def _fit_unlabelled(data: list[Features], task: SequenceTask, mapping: FeatureMap,
                    rng: np.random.Generator) -> SequenceModel:  # fmt: skip
    """EM with and without a settled state after the last event; the better by BIC."""
    candidates = []
    for settled in (False, True):
        learner = _Learner(data, task.sequence, optional_states(task, settled), [None] * len(data))
        # While learning, a cell counts as one observation; how far cells repeat each other matters
        # for the uncertainty of boundaries and is measured afterwards.
        num_cells, num_features = learner.stacked.shape
        results = [learner.run(paths, 1 / num_features) for paths in _starts(learner, rng)]
        emissions, probability, log_evidence = max(results, key=lambda result: result[2])
        # Two parameters a feature and state (Schwarz, Ann. Stat. 6, 1978).
        score = log_evidence - settled * num_features * np.log(num_cells / num_features)
        candidates.append((score, learner, emissions, probability))
    _, learner, emissions, probability = max(candidates, key=lambda each: each[0])
    emissions = replace(emissions, temper=learner.independent_share(emissions, probability))
    probability, _ = learner.expect(emissions, probability)
    return _finish(data, task, mapping, learner, emissions, probability, None)


def _starts(learner: _Learner, rng: np.random.Generator) -> list[list[np.ndarray]]:
    """Paths of all trials to start from: optimal partitions, equal parts, random parts."""
    squashed = [np.arcsinh(filled(values)) for values in learner.values]
    starts = [[partition(v, learner.num_states, floor) for v in squashed] for floor in START_FLOORS]
    shares = [np.full(learner.num_states, 1 / learner.num_states)]
    shares += [rng.dirichlet(np.full(learner.num_states, 2.0)) for _ in range(RANDOM_STARTS)]
    for share in shares:
        cuts = np.cumsum(share)[:-1]
        starts.append([np.searchsorted(cuts, (np.arange(len(v)) + 0.5) / len(v)) for v in learner.values])
    return starts


def _fit_labelled(data: list[Features], task: SequenceTask, mapping: FeatureMap,
                  boundaries: list[np.ndarray | None]) -> SequenceModel:  # fmt: skip
    known = [None if b is None else labelled_path(d, b) for d, b in zip(data, boundaries, strict=True)]
    with_labels = [i for i, path in enumerate(known) if path is not None]
    optional = optional_states(task, settled=False)
    taught = _Learner(
        [data[i] for i in with_labels], task.sequence, optional, [known[i] for i in with_labels]
    )
    probability = [np.eye(len(optional))[path] for path in taught.known]
    emissions = from_weights(taught.stacked, taught.pooled(probability), FLOORS[-1], 1.0)
    emissions = replace(emissions, temper=taught.independent_share(emissions, probability))
    law = transitions(*taught.durations(probability), optional)
    detectors = choose_detectors(
        taught.values, [b for b in boundaries if b is not None], [data[i].edges for i in with_labels],
        [path for path in known if path is not None], emissions.temper, FLOORS[-1], law,
    )  # fmt: skip
    learner = _Learner(data, task.sequence, optional, known)
    if len(with_labels) < len(data):
        # Labelled emissions place the other trials; then all of them teach together.
        start = transitions(*taught.durations(probability), optional)
        parts = [weights(v, emissions, detectors, start.bands) for v in learner.values]
        aligned = align_many([p[0] for p in parts], [p[1] for p in parts],
                             log_initial=start.log_initial, log_final=start.log_final)  # fmt: skip
        paths = [a.path if k is None else k for a, k in zip(aligned, known, strict=True)]
        emissions, probability, _ = learner.run(paths, emissions.temper, FLOORS[-1:], detectors)
    return _finish(data, task, mapping, learner, emissions, probability, detectors)


def _finish(data: list[Features], task: SequenceTask, mapping: FeatureMap, learner: _Learner,
            emissions: StudentEmissions, probability: list[np.ndarray],
            detectors: Detectors | None) -> SequenceModel:  # fmt: skip
    """The model with what its own trials score, so that misfits can be told."""
    mean_cells, presence = learner.durations(probability)
    typical = np.median([p.sum(0) for p in probability], 0)
    settled = learner.num_states > len(task.sequence)
    model = SequenceModel(task, mapping, emissions, mean_cells, presence, settled, detectors, typical,
                          np.tile([0.0, np.inf], (2, 1)))  # fmt: skip
    per_trial = [
        sequence_misfit.scores(emissions.log_likelihoods(each.values), mean_cells, alignment)
        for each, alignment in zip(data, replace(model, detectors=None).align(data), strict=True)
    ]
    return replace(model, misfit=sequence_misfit.reference(per_trial))
