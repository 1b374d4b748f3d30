"""Learn a plain ordered task from trials: EM within the forced order, from labels if there are any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.alignment import align_many
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence import misfit as sequence_misfit
from hmmseg.sequence.detectors import Detectors
from hmmseg.sequence.emissions import StudentEmissions, from_weights
from hmmseg.sequence.features import FeatureMap, Features, feature_map, features
from hmmseg.sequence.labels import Labels, choose_detectors, forbidden, labelled_path, read_labels, shares
from hmmseg.sequence.learner import FLOORS, STEPS_PER_FLOOR, Learner
from hmmseg.sequence.model import Alternative, SequenceModel, optional_states, weights
from hmmseg.sequence.readings import COARSE_CELLS, coarse, expected_right, find_readings, probabilities
from hmmseg.sequence.transitions import transitions

LEAST_PROBABLE = 0.02  # numerics: readings below are left out
MOST_KEPT = 8  # numerics: readings in a model
BOUNDARY_INDEPENDENT = 250.0  # learned: independent observations of one trial that tell of its boundaries
ENOUGH = (
    2  # numerics: trials with all their labels for boundary templates: one must be left out to weigh them
)


def fit_sequence(
    trials: Sequence[Trial],
    task: SequenceTask,
    labels: Labels | None = None,
) -> SequenceModel:
    """Emissions and durations of a plain ordered task.

    `labels` maps a trial's name (with or without its suffix) to its boundaries [s], one fewer than
    subtasks, None where unknown, or to {subtask: its start}; a skipped optional subtask has two equal ones.
    One boundary of one trial helps, and trials without labels help too. Raises InputError for trials too
    short for the task, missing channels and labels that do not fit.
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
    if len(task.sequence) > 1 and sum(np.isfinite(b).all() for b in boundaries) >= ENOUGH:
        return _fit_labelled(data, task, mapping, boundaries)
    return _fit_unlabelled(data, task, mapping, boundaries)


def _channels(trials: Sequence[Trial], task: SequenceTask) -> tuple[str, ...]:
    if task.channels is not None:
        return task.channels
    common = [name for name in trials[0].channels if all(name in t.channels for t in trials)]
    if not common:
        raise InputError(trials[0].file, "shares no channel with the other trials", "a common column")
    return tuple(common)


def _fit_unlabelled(data: list[Features], task: SequenceTask, mapping: FeatureMap,
                    boundaries: list[np.ndarray]) -> SequenceModel:  # fmt: skip
    """All probable readings of the trials, given what few labels there are."""
    factor = max(1, round(float(np.median([len(each.values) for each in data])) / COARSE_CELLS))
    known = [shares(each, b) for each, b in zip(data, boundaries, strict=True)]
    readings = find_readings([coarse(each.values, factor) for each in data], task.sequence,
                             optional_states(task, False), known)  # fmt: skip
    probability = probabilities(readings)
    right = expected_right(readings, probability)
    order = [i for i in np.argsort(-probability) if probability[i] >= LEAST_PROBABLE][:MOST_KEPT]
    first = max(order, key=lambda i: right[i])
    order = [first, *[i for i in order if i != first]]
    total = probability[order].sum()
    models = []
    for i in order:
        reading = readings[i]
        learner = Learner([each.values for each in data], task.sequence,
                          optional_states(task, reading.settled))  # fmt: skip
        learner.allowed = [
            forbidden(each, b, learner.num_states) for each, b in zip(data, boundaries, strict=True)
        ]
        fine = [
            np.repeat(p, factor, axis=0)[: len(each.values)]
            for p, each in zip(reading.probability, data, strict=True)
        ]
        emissions, fine, _ = learner.run(fine, 1 / learner.stacked.shape[1], FLOORS[-1:])
        emissions = replace(emissions, temper=_coarsened(learner, emissions, fine))
        fine = [a.smoothed for a in learner.align(emissions, fine)]
        models.append(_finish(data, task, mapping, learner, emissions, fine, None))
    shares_of = [float(probability[i] / total) for i in order]
    others = tuple(Alternative(p, model) for p, model in zip(shares_of[1:], models[1:], strict=True))
    return replace(models[0], others=others)


def _coarsened(learner: Learner, emissions: StudentEmissions, probability: list[np.ndarray]) -> float:
    """Temper of emissions that nobody taught: the independent share, coarsened (hmmseg.sequence.readings).

    Where exactly a gradual change is the boundary, no number of samples of it says.
    """
    share = learner.independent_share(emissions, probability)
    observations = share * learner.stacked.size / len(learner.values)
    return share * BOUNDARY_INDEPENDENT / (BOUNDARY_INDEPENDENT + observations)


def _fit_labelled(data: list[Features], task: SequenceTask, mapping: FeatureMap,
                  boundaries: list[np.ndarray]) -> SequenceModel:  # fmt: skip
    with_labels = [i for i, b in enumerate(boundaries) if np.isfinite(b).all()]
    known = [labelled_path(d, b) if np.isfinite(b).all() else None
             for d, b in zip(data, boundaries, strict=True)]  # fmt: skip
    optional = optional_states(task, settled=False)
    paths = [path for path in known if path is not None]
    taught = Learner([data[i].values for i in with_labels], task.sequence, optional)
    probability = taught.one_hot(paths)
    emissions = from_weights(taught.stacked, taught.pooled(probability), FLOORS[-1], 1.0)
    emissions = replace(emissions, temper=taught.independent_share(emissions, probability))
    law = transitions(*taught.durations(probability), optional)
    detectors = choose_detectors(
        taught.values, [boundaries[i] for i in with_labels], [data[i].edges for i in with_labels],
        paths, emissions.temper, FLOORS[-1], law,
    )  # fmt: skip
    learner = Learner([each.values for each in data], task.sequence, optional)
    learner.known = known
    if len(with_labels) < len(data):
        # Labelled emissions place the other trials; then all of them teach together.
        learner.allowed = [
            forbidden(each, b, learner.num_states) if path is None else None
            for each, b, path in zip(data, boundaries, known, strict=True)
        ]
        parts = [weights(v, emissions, detectors, law.bands) for v in learner.values]
        tables = [p[0] if a is None else p[0] + a for p, a in zip(parts, learner.allowed, strict=True)]
        aligned = align_many(tables, [p[1] for p in parts],
                             log_initial=law.log_initial, log_final=law.log_final)  # fmt: skip
        start = learner.one_hot([a.path if k is None else k for a, k in zip(aligned, known, strict=True)])
        emissions, probability, _ = learner.run(
            start, emissions.temper, FLOORS[-1:], detectors, STEPS_PER_FLOOR
        )
    return _finish(data, task, mapping, learner, emissions, probability, detectors)


def _finish(data: list[Features], task: SequenceTask, mapping: FeatureMap, learner: Learner,
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
