"""Learn a plain ordered task from trials: EM within the forced order, from labels if there are any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.chain import Chain
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.courses import (
    COARSE_CELLS,
    WEIGHING,
    Course,
    Naming,
    best_choice,
    coarse,
    find_courses,
    naming,
    probabilities,
)
from hmmseg.sequence.emissions import Detectors, StudentEmissions, detecting, from_weights, learn
from hmmseg.sequence.features import FeatureMap, SequenceFeatures, feature_map, features
from hmmseg.sequence.learner import FLOORS, Learner
from hmmseg.sequence.model import NamedCourse, SequenceModel, misfit_scores, optional_states, usual_misfit

Labels = Mapping[str, Any]  # a trial's name and what is known of its boundaries [s], checked here
HALVES = (0.0075, 0.02, 0.05)  # prior: half a window, as a share of a trial's length
WEIGHTS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)  # prior: of templates; held-out labels choose
STATE_WEIGHTS = (0.03, 0.2, 1.0)  # prior: of the emissions next to them, likewise
FORGIVING = 1e-4  # prior: least probability of a held-out label, so that one odd label does not decide


def read_labels(trials: Sequence[Trial], task: SequenceTask, labels: Labels) -> list[np.ndarray]:
    """Boundaries (num_subtasks - 1,) [s] of each trial, NaN where unknown; InputError for misfits."""
    stems = [Path(trial.file).stem for trial in trials]
    for name in labels:
        if stems.count(Path(name).stem) > 1:
            raise InputError(
                "labels", f"{name} names {stems.count(Path(name).stem)} trials", "one of each name"
            )
    found, used = [], 0
    for trial in trials:
        given = labels.get(Path(trial.file).stem, labels.get(trial.name))
        used += given is not None
        found.append(
            np.full(len(task.sequence) - 1, np.nan) if given is None else _checked(given, trial, task)
        )
    if labels and not used:
        raise InputError("labels", f"none is for these trials (there are {', '.join(sorted(labels))})",
                         f"names such as {Path(trials[0].file).stem}")  # fmt: skip
    return found


def _checked(given: Any, trial: Trial, task: SequenceTask) -> np.ndarray:
    where = f"labels of {trial.file}"
    if isinstance(given, Mapping):
        given = _by_subtask(given, where, task)
    try:
        unknown = np.array([each is None for each in given], bool)
        boundaries = np.array([np.nan if each is None else each for each in given], dtype=float)
    except (TypeError, ValueError):
        raise InputError(where, f"found {given!r}", "a list of times in s") from None
    expected = len(task.sequence) - 1
    if boundaries.shape != (expected,):
        raise InputError(
            where, f"has {boundaries.size} boundaries", f"{expected} for {expected + 1} subtasks"
        )
    if not np.isfinite(boundaries[~unknown]).all():
        raise InputError(where, "has a boundary that is no number", "times in s")
    at = np.flatnonzero(~unknown)
    if not at.size:
        raise InputError(where, "has no boundary", "at least one time in s")
    if boundaries[at[0]] < trial.t[0] or boundaries[at[-1]] > trial.t[-1]:
        raise InputError(where, f"has boundaries {boundaries[at].tolist()}",
                         f"times between {trial.t[0]:g} and {trial.t[-1]:g} s")  # fmt: skip
    for i, k in pairwise(at):
        gap = boundaries[k] - boundaries[i]
        skipped = all(name in task.optional for name in task.sequence[i + 1 : k + 1])
        if gap < 0 or (gap == 0 and not skipped):
            raise InputError(where, f"boundary {k + 1} ({boundaries[k]:g}) does not come after "
                             f"boundary {i + 1} ({boundaries[i]:g})", "increasing times")  # fmt: skip
    return boundaries


def _by_subtask(given: Mapping[str, Any], where: str, task: SequenceTask) -> list[Any]:
    """{subtask: its start} as a list of boundaries."""
    names = task.sequence[1:]
    for name in given:
        if names.count(name) != 1:
            raise InputError(where, f"gives the start of {name!r}, which "
                             + ("comes more than once" if name in names else "has none in this task"),
                             f"one of {', '.join(names)}, or a list of boundaries")  # fmt: skip
    return [given.get(name) for name in names]


def labelled_path(trial: SequenceFeatures, boundaries: np.ndarray) -> np.ndarray:
    """Path (num_cells,) of subtask numbers; a cell belongs to the subtask of its middle."""
    middle = (trial.edges[1:] + trial.edges[:-1]) / 2
    return np.searchsorted(boundaries, middle, side="right")


def shares(trial: SequenceFeatures, boundaries: np.ndarray) -> np.ndarray:
    """Boundaries [s] as shares of the trial."""
    return (boundaries - trial.edges[0]) / (trial.edges[-1] - trial.edges[0])


def forbidden(trial: SequenceFeatures, boundaries: np.ndarray, num_states: int) -> np.ndarray | None:
    """Log weights (num_cells, num_states) that keep labelled boundaries [s] to a cell; None without any.

    -inf where a label forbids a state, 0 elsewhere.
    """
    if not np.isfinite(boundaries).any():
        return None
    middle = (trial.edges[1:] + trial.edges[:-1]) / 2
    reach = trial.edges[1] - trial.edges[0]
    out = np.zeros((len(middle), num_states))
    for b in np.flatnonzero(np.isfinite(boundaries)):
        out[middle < boundaries[b] - reach, b + 1 :] = -np.inf
        out[middle > boundaries[b] + reach, : b + 1] = -np.inf
    return out


def choose_detectors(values: list[np.ndarray], boundaries: list[np.ndarray], edges: list[np.ndarray],
                     paths: list[np.ndarray], temper: float, floor: float,
                     law: Chain) -> Detectors | None:  # fmt: skip
    """Detectors whose window and weights place held-out labels best (each trial left out once).

    The score is the log probability of the labelled cell edge and its neighbours, so weights that
    make boundaries overconfident lose. None for a single subtask. One labelled trial cannot be left
    out: then the middle window with the emissions' own share of independent observations.
    """
    num_states = law.num_states
    if num_states == 1:
        return None
    channels = [v[:, : v.shape[1] // 2] for v in values]
    cells = [np.searchsorted(e, b) - 1 for e, b in zip(edges, boundaries, strict=True)]
    cells = [
        np.where(np.abs(e[c + 1] - b) > np.abs(e[c] - b), c - 1, c)
        for c, e, b in zip(cells, edges, boundaries, strict=True)
    ]
    own = [shown(c) for c in cells]
    length = float(np.median([len(v) for v in values]))
    halves = sorted({max(round(share * length), 2) for share in HALVES})
    if len(values) == 1:
        return replace(learn(channels, own, halves[len(halves) // 2]), weight=temper)
    found = []
    for half in halves:
        scores, scatter = _held_out(values, channels, cells, paths, half, temper, floor, law)
        i, j = np.unravel_index(scores.argmax(), scores.shape)
        found.append((scores[i, j], half, WEIGHTS[i], STATE_WEIGHTS[j], scatter[i, j]))
    _, half, weight, state_weight, jitter = max(found, key=lambda each: each[0])
    return replace(learn(channels, own, half), jitter=jitter, weight=weight, state_weight=state_weight)


def _held_out(values, channels, cells, paths, half, temper, floor,
              law: Chain) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Mean log probability of held-out labels for every pair of weights, and their extra scatter.

    The scatter (num_weights, num_state_weights, num_boundaries) [cells] is what the squared
    differences from the posterior means exceed the posterior variances by.
    """
    parts = []
    for i in range(len(values)):
        rest = [j for j in range(len(values)) if j != i]
        onehot = np.eye(law.num_states)[np.concatenate([paths[j] for j in rest])]
        emissions = from_weights(np.vstack([values[j] for j in rest]), onehot, floor, temper)
        detectors = learn([channels[j] for j in rest], [shown(cells[j]) for j in rest], half)
        ll, ratios = emissions.log_likelihoods(values[i]), detectors.log_ratios(channels[i])
        parts += [(s * ll, detecting(law, w * ratios)) for w in WEIGHTS for s in STATE_WEIGHTS]
    aligned = align([p[0] for p in parts], [p[1] for p in parts])
    grid = (len(values), len(WEIGHTS), len(STATE_WEIGHTS))
    per_trial = grid[1] * grid[2]
    scores = [_log_probability(a, cells[n // per_trial]) for n, a in enumerate(aligned)]
    excess = [_excess_scatter(a, cells[n // per_trial]) for n, a in enumerate(aligned)]
    scatter = np.maximum(np.mean(np.reshape(excess, (*grid, -1)), 0), 0.0)
    return np.reshape(scores, grid).mean(0), np.sqrt(scatter)


def shown(cells: np.ndarray) -> np.ndarray:
    """Labelled edges, -1 for the boundaries of a skipped subtask (equal ones): not their own course."""
    equal = np.diff(cells) == 0
    return np.where(np.r_[equal, False] | np.r_[False, equal], -1, cells)


def _excess_scatter(alignment: AlignmentPosterior, cells: np.ndarray) -> np.ndarray:
    """Squared difference of each label from its posterior mean, less the variance [cells^2]."""
    crossing = boundary_probabilities(alignment)
    index = np.arange(len(crossing))[:, None]
    mean = (crossing * index).sum(0)
    return (mean - cells) ** 2 - (crossing * (index - mean) ** 2).sum(0)


def _log_probability(alignment: AlignmentPosterior, cells: np.ndarray) -> float:
    """Mean log posterior probability that each boundary is within one cell of its label."""
    crossing = boundary_probabilities(alignment)
    total = 0.0
    for b, cell in enumerate(cells):
        total += np.log(crossing[max(cell - 1, 0) : cell + 2, b].sum() + FORGIVING)
    return total / len(cells)


def boundary_probabilities(alignment: AlignmentPosterior) -> np.ndarray:
    """Probability (num_cells - 1, num_states - 1) that subtasks up to k end at each cell edge."""
    return alignment.boundary


LEAST_PROBABLE = 0.002  # numerics: courses below are left out
MOST_KEPT = 16  # numerics: courses in a model
ENOUGH = (
    2  # numerics: trials with all their labels for boundary templates: one must be left out to weigh them
)


def fit_sequence(trials: Sequence[Trial], task: SequenceTask, labels: Labels | None = None) -> SequenceModel:
    """Learn emissions and durations of a plain ordered task.

    Args:
        trials: recordings, labelled or not; those without labels help too.
        task: the order of the subtasks.
        labels: by a trial's name (with or without its suffix) its boundaries [s], one fewer than subtasks,
            None where unknown, or {subtask: its start}; a skipped optional subtask has two equal ones.

    Returns:
        The model learned.

    Raises:
        InputError: trials too short for the task, missing channels or labels that do not fit.
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
    """The model with what its own trials score, so that misfits can be recognised."""
    mean_cells, presence = learner.durations(probability)
    typical = np.median([p.sum(0) for p in probability], 0)
    settled = learner.num_states > len(task.sequence)
    model = SequenceModel(task, mapping, emissions, mean_cells, presence, settled, detectors, typical,
                          np.tile([0.0, np.inf], (2, 1)))  # fmt: skip
    per_trial = []
    for each in data:
        plain = model.without_templates(each)
        ll = plain.emissions.log_likelihoods(each.values)
        per_trial.append(misfit_scores(ll, mean_cells, plain.align([each])[0]))
    return replace(model, usual_scores=usual_misfit(per_trial))
