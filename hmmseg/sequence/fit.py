"""Learn a plain ordered task from trials: EM within the forced order, from labels if there are any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence import misfit as sequence_misfit
from hmmseg.sequence.courses import COARSE_CELLS, Course, coarse, find_courses
from hmmseg.sequence.detectors import Detectors
from hmmseg.sequence.emissions import StudentEmissions, from_weights
from hmmseg.sequence.features import FeatureMap, SequenceFeatures, feature_map, features
from hmmseg.sequence.labels import Labels, choose_detectors, forbidden, labelled_path, read_labels, shares
from hmmseg.sequence.learner import FLOORS, Learner
from hmmseg.sequence.model import NamedCourse, SequenceModel, optional_states
from hmmseg.sequence.naming import WEIGHING, Naming, best_choice, naming, probabilities

LEAST_PROBABLE = 0.002  # numerics: courses below are left out
MOST_KEPT = 16  # numerics: courses in a model
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


def _fit_unlabelled(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap,
                    boundaries: list[np.ndarray]) -> SequenceModel:  # fmt: skip
    """All courses of the trials with what their changes may be, given what few labels there are."""
    values, num_states = [each.values for each in data], len(task.sequence)
    if num_states == 1:
        learner = Learner(values, task.sequence, optional_states(task, False))
        start = [np.ones((len(v), 1)) for v in values]
        return _finish(data, task, mapping, learner, *_settle(learner, start), None)
    factor = max(1, round(float(np.median([len(v) for v in values])) / COARSE_CELLS))
    known = [shares(each, b) for each, b in zip(data, boundaries, strict=True)]
    courses = find_courses([coarse(v, factor) for v in values], num_states, known)
    namings = [naming(course, num_states, known) for course in courses]
    probability = probabilities(namings)
    choice = best_choice(courses, namings, probability)
    learner = Learner(values, task.sequence, optional_states(task, choice.settled))
    learner.allowed = [forbidden(d, b, learner.num_states) for d, b in zip(data, boundaries, strict=True)]
    stretches = _fine(courses[choice.course], factor, values)
    start = [np.searchsorted(np.array(choice.ends) - 0.5, p.argmax(1)) for p in stretches]
    model = _finish(data, task, mapping, learner, *_settle(learner, learner.one_hot(start)), None)
    order = [i for i in np.argsort(-probability) if probability[i] >= LEAST_PROBABLE][:MOST_KEPT]
    total = float(probability[order].sum())
    named = tuple(
        _named(data, boundaries, courses[i], namings[i], float(probability[i]) / total, factor) for i in order
    )
    scale = np.where(np.isfinite(boundaries).any(0), WEIGHING.labelled, WEIGHING.lag)
    lag = scale * float(np.median([len(v) for v in values]))
    return replace(model, courses=named, lag=lag, sure=choice.right)


def _settle(learner: Learner, start: list[np.ndarray]) -> tuple[StudentEmissions, list[np.ndarray]]:
    """EM at the finest scale, with the emissions' own share of independent observations in the end."""
    emissions, probability = learner.run(start, 1 / learner.stacked.shape[1], FLOORS[-2:])
    emissions = replace(emissions, temper=learner.independent_share(emissions, probability))
    return emissions, [a.smoothed for a in learner.align(emissions, learner.law(probability))]


def _fine(course: Course, factor: int, values: list[np.ndarray]) -> list[np.ndarray]:
    """Probabilities [(num_cells, num_stretches), ...] of a course's stretches on the fine grid."""
    return [np.repeat(p, factor, axis=0)[: len(v)] for p, v in zip(course.probability, values, strict=True)]


def _named(data: list[SequenceFeatures], boundaries: list[np.ndarray], course: Course, found: Naming,
           probability: float, factor: int) -> NamedCourse:  # fmt: skip
    """A course on the fine grid, and what labels say of how far boundaries lie off its changes."""
    number = len(course.cost) - 1
    values = [each.values for each in data]
    learner = Learner(values, [f"{k}" for k in range(number)], [False] * number)
    stretches = _fine(course, factor, values)
    emissions = from_weights(learner.stacked, learner.pooled(stretches), FLOORS[-1], 1.0)
    emissions = replace(emissions, temper=learner.independent_share(emissions, stretches))
    mean_cells = np.maximum(np.mean([p.sum(0) for p in stretches], 0), 1.5)
    lags = np.array([
        (shares(each, b)[:, None] - ends) * len(each.values)
        for each, b, ends in zip(data, boundaries, course.ends, strict=True)
    ])  # fmt: skip
    labelled = np.isfinite(lags)
    shift = np.where(labelled, lags, 0.0).sum(0) / np.maximum(labelled.sum(0), 1)
    return NamedCourse(probability, emissions, mean_cells, found.probability, shift)


def _fit_labelled(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap,
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
    law = taught.law(probability)
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
        aligned = learner.align(emissions, law, detectors)
        start = learner.as_labelled(learner.one_hot([a.path for a in aligned]))
        emissions, probability = learner.run(start, emissions.temper, FLOORS[-1:], detectors)
    return _finish(data, task, mapping, learner, emissions, probability, detectors)


def _finish(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap, learner: Learner,
            emissions: StudentEmissions, probability: list[np.ndarray],
            detectors: Detectors | None) -> SequenceModel:  # fmt: skip
    """The model with what its own trials score, so that misfits can be told."""
    mean_cells, presence = learner.durations(probability)
    typical = np.median([p.sum(0) for p in probability], 0)
    settled = learner.num_states > len(task.sequence)
    model = SequenceModel(task, mapping, emissions, mean_cells, presence, settled, detectors, typical,
                          np.tile([0.0, np.inf], (2, 1)))  # fmt: skip
    per_trial = []
    for each in data:
        plain = model.without_templates(each)
        ll = plain.emissions.log_likelihoods(each.values)
        per_trial.append(sequence_misfit.scores(ll, mean_cells, plain.align([each])[0]))
    return replace(model, usual_scores=sequence_misfit.reference(per_trial))
