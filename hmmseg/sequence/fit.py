"""Fit a plain ordered task to trials: EM within the forced order, from labels where there are any."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.chain import Chain
from hmmseg.hmm.inference import align
from hmmseg.io.formats.delimited import find_layout, rows_in
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.courses import (
    COARSE_CELLS,
    WEIGHING,
    Course,
    Naming,
    best_choice,
    coarsen,
    find_courses,
    naming,
    probabilities,
)
from hmmseg.sequence.emissions import (
    FLOORS,
    LEAST_CELLS,
    Detectors,
    Learner,
    StudentEmissions,
    add_detectors,
    durations,
    learn,
)
from hmmseg.sequence.features import FeatureMap, SequenceFeatures, feature_map, features
from hmmseg.sequence.model import NamedCourse, SequenceModel, optional_states, usual_misfit

Labels = Any  # known boundaries [s] as users give them: see `read_labels`
HALVES = (0.0075, 0.02, 0.05)  # prior: half a window, as a share of a trial's length
WEIGHTS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)  # prior: of templates; held-out labels choose
STATE_WEIGHTS = (0.03, 0.2, 1.0)  # prior: of the emissions next to them, likewise
FORGIVING = 1e-4  # prior: least probability of a held-out label, so that one odd label does not decide
LEAST_PROBABLE = 0.002  # numerics: courses less probable than this are dropped
MOST_KEPT = 16  # numerics: courses in a model
COLUMNS = ("trial", "subtask", "start")  # of a table of labels
ENOUGH = 2  # numerics: fully labelled trials for boundary templates: one is left out to weigh them


def fit_sequence(trials: Sequence[Trial], task: SequenceTask, labels: Labels | None = None) -> SequenceModel:
    """Learn emissions and durations of a plain ordered task.

    Args:
        trials: recordings, labelled or not; unlabelled ones contribute too.
        task: the order of the subtasks.
        labels: as `read_labels` takes them; None of no trial.

    Returns:
        The fitted model.

    Raises:
        InputError: trials too short for the task, missing channels or labels that do not fit.
    """
    if not trials:
        raise InputError("trials", "none given", "at least one trial")
    channels = task.channels or tuple(n for n in trials[0].channels if all(n in t.channels for t in trials))
    if not channels:
        raise InputError(trials[0].file, "shares no channel with the other trials", "a common column")
    mapping = feature_map(trials, channels)
    data = [features(trial, mapping) for trial in trials]
    for trial, each in zip(trials, data, strict=True):
        if len(each.values) < 2 * len(task.sequence):
            raise InputError(trial.file, f"has {len(each.values)} samples",
                             f"at least two for each of {len(task.sequence)} subtasks")  # fmt: skip
    boundaries = read_labels(trials, task, labels)
    labelled = sum(np.isfinite(b).all() for b in boundaries) >= ENOUGH
    learned = _fit_labelled if labelled and len(task.sequence) > 1 else _fit_unlabelled
    return learned(data, task, mapping, boundaries)


def read_labels(trials: Sequence[Trial], task: SequenceTask, labels: Labels) -> list[np.ndarray]:
    """Known boundaries of each trial.

    Args:
        trials: recordings of the task.
        task: the order of the subtasks.
        labels: one entry for each trial, or entries by the trials' names (with or without suffix), or a
            folder or table for `label_files`. An entry holds boundaries [s], one fewer than subtasks, None
            where unknown, or {subtask: its start}; a skipped optional subtask has two equal ones. None: no
            label.

    Returns:
        Boundaries (num_subtasks - 1,) [s] of each trial, NaN where unknown.

    Raises:
        InputError: labels that are none of these trials', or do not fit the task.
    """
    if isinstance(labels, str | Path):
        labels = label_files(Path(labels), trials)
    if isinstance(labels, Mapping):
        for name in labels:
            if (count := sum(_is_named(name, trial) for trial in trials)) > 1:
                raise InputError("labels", f"{name} names {count} trials", "one of each name, or a list")
        given = [next((labels[n] for n in labels if _is_named(n, trial)), None) for trial in trials]
        if labels and all(each is None for each in given):
            raise InputError("labels", f"none is for these trials (there are {', '.join(sorted(labels))})",
                             f"names such as {trials[0].stem}")  # fmt: skip
    else:
        given = [None] * len(trials) if labels is None else list(labels)
        if len(given) != len(trials):
            raise InputError("labels", f"are {len(given)} for {len(trials)} trials",
                             "one entry for each, None where unknown, or a dict by their names")  # fmt: skip
    unknown = np.full(len(task.sequence) - 1, np.nan)
    return [unknown if each is None else _check_labels(each, trial, task)
            for each, trial in zip(given, trials, strict=True)]  # fmt: skip


def _is_named(name: str, trial: Trial) -> bool:
    return trial.stem in (name, Path(name).stem) or name == trial.name


def label_files(where: Path, trials: Sequence[Trial]) -> dict[str, Any]:
    """Labels by trial, from a folder or a table.

    Args:
        where: a folder with NAME.json for some of the trials, {"boundaries": [times in s, null where
            unknown]}, or a table (CSV, TSV in any dialect) with the columns trial, subtask and start [s].
        trials: the trials.

    Returns:
        Entries for `read_labels` by the trials' names.

    Raises:
        InputError: there are no labels, they cannot be read, or they are of other trials.
    """
    if where.is_dir():
        files = {trial.name: where / f"{trial.stem}.json" for trial in trials}
        out = {name: _boundaries(path) for name, path in files.items() if path.exists()}
        if not out:
            few = ", ".join(path.name for path in [*files.values()][:3])
            raise InputError(f"labels {where}", "has labels for none of the trials", f"files like {few}")
        return out
    if not where.is_file() or where.suffix.lower() not in (".csv", ".tsv"):
        problem = f"ends in {where.suffix!r}" if where.is_file() else "no such file or folder"
        raise InputError(f"labels {where}", problem, "a folder or a .csv file")
    found = dict[str, dict[str, float]]()
    for given, starts in _table(where).items():
        names = [trial.name for trial in trials if _is_named(given, trial)]
        if not names:
            raise InputError(str(where), f"labels {given!r}, which is none of the trials",
                             f"one of {', '.join(trial.stem for trial in trials)}")  # fmt: skip
        found |= {name: starts for name in names}
    return found


def _boundaries(path: Path) -> list[float | None]:
    try:
        given = json.loads(path.read_text(encoding="utf-8-sig"))["boundaries"]
        return [None if each is None else float(each) for each in given]
    except (OSError, ValueError, TypeError, KeyError):
        raise InputError(str(path), "cannot be read", '{"boundaries": [times in s]}') from None


def _table(path: Path) -> dict[str, dict[str, float]]:
    """Starts [s] by subtask by trial, from a table; names stay text, as `01` is no number."""
    layout = find_layout(path)
    for name in COLUMNS:
        if name not in layout.names or not layout.rows.size:
            found = f"has no column {name}" if layout.rows.size else "has no rows"
            raise InputError(str(path), found, f"the columns {', '.join(COLUMNS)}")
    out: dict[str, dict[str, float]] = {}
    for number, cells in rows_in(path, layout):
        trial, subtask, start = (cells[layout.names.index(name)].strip() for name in COLUMNS)
        try:
            time = float(start.replace(",", "."))
        except ValueError:
            raise InputError(f"{path}: row {number}", f"start {start!r}", "a time in s") from None
        if subtask in out.setdefault(trial, {}):
            raise InputError(f"{path}: row {number}", f"labels {subtask} of {trial} again", "one start each")
        out[trial][subtask] = time
    return out


def _check_labels(given: Any, trial: Trial, task: SequenceTask) -> np.ndarray:
    where, names = f"labels of {trial.file}", task.sequence[1:]
    if isinstance(given, Mapping):
        first = given.get(task.sequence[0])  # begins with the recording
        at_start = isinstance(first, int | float) and first <= trial.t[0]
        for name in given:
            if names.count(name) != 1 and not (name == task.sequence[0] and at_start):
                why = "comes more than once" if name in names else "has none in this task"
                raise InputError(where, f"gives the start of {name!r}, which {why}",
                                 f"one of {', '.join(names)}, or a list of boundaries")  # fmt: skip
        given = [given.get(name) for name in names]
    try:
        unknown = np.array([each is None for each in given], bool)
        boundaries = np.array([np.nan if each is None else each for each in given], dtype=float)
    except (TypeError, ValueError):
        raise InputError(where, f"found {given!r}", "a list of times in s") from None
    if boundaries.shape != (len(names),):
        expected = f"{len(names)} for {len(names) + 1} subtasks"
        raise InputError(where, f"has {boundaries.size} boundaries", expected)
    if not np.isfinite(boundaries[~unknown]).all():
        raise InputError(where, "has a boundary that is no number", "times in s")
    at = np.flatnonzero(~unknown)
    if not at.size:
        raise InputError(where, "has no boundary", "at least one time in s")
    if boundaries[at[0]] < trial.t[0] or boundaries[at[-1]] > trial.t[-1]:
        raise InputError(where, f"has boundaries {boundaries[at].tolist()}",
                         f"times between {trial.t[0]:.13g} and {trial.t[-1]:.13g} s")  # fmt: skip
    for i, k in pairwise(at):
        gap = boundaries[k] - boundaries[i]
        if gap < 0 or (gap == 0 and not set(task.sequence[i + 1 : k + 1]) <= set(task.optional)):
            raise InputError(where, f"boundary {k + 1} ({boundaries[k]:g}) does not come after "
                             f"boundary {i + 1} ({boundaries[i]:g})", "increasing times")  # fmt: skip
    return boundaries


def label_constraints(trial: SequenceFeatures, boundaries: np.ndarray, num_states: int) -> np.ndarray | None:
    """Log weights (num_cells, num_states), 0 or -inf, that keep labels [s] within a cell; None without."""
    if not np.isfinite(boundaries).any():
        return None
    reach, out = trial.edges[1] - trial.edges[0], np.zeros((len(trial.middle), num_states))
    for b in np.flatnonzero(np.isfinite(boundaries)):
        out[trial.middle < boundaries[b] - reach, b + 1 :] = -np.inf
        out[trial.middle > boundaries[b] + reach, : b + 1] = -np.inf
    return out


def choose_detectors(taught: Learner, data: Sequence[SequenceFeatures], boundaries: Sequence[np.ndarray],
                     paths: Sequence[np.ndarray], temper: float, law: Chain) -> Detectors:  # fmt: skip
    """Detectors whose window and weights give held-out labels the highest log probability within a cell."""
    channels = [v[:, : v.shape[1] // 2] for v in taught.values]
    cells = [np.searchsorted(d.middle, b, side="right") - 1 for d, b in zip(data, boundaries, strict=True)]
    shown = [_shown(each) for each in cells]
    length = float(np.median([len(v) for v in taught.values]))
    halves = sorted({max(round(share * length), 2) for share in HALVES})
    onehot = [np.eye(law.num_states)[path] for path in paths]
    rests = [[j for j in range(len(data)) if j != i] for i in range(len(data))]
    lls = []
    for i, rest in enumerate(rests):
        others = Learner([taught.values[j] for j in rest], taught.names, taught.optional)
        emissions = others.emissions([onehot[j] for j in rest], FLOORS[-1], temper)
        lls.append(emissions.log_likelihoods(taught.values[i]))
    grid = [(weight, state_weight) for weight in WEIGHTS for state_weight in STATE_WEIGHTS]
    best, chosen = -np.inf, None
    for half in halves:
        tables, chains = [], []
        for i, rest in enumerate(rests):
            detectors = learn([channels[j] for j in rest], [shown[j] for j in rest], half)
            ratios = detectors.log_ratios(channels[i])
            tables += [state_weight * lls[i] for _, state_weight in grid]
            chains += [add_detectors(law, weight * ratios) for weight, _ in grid]
        held_out = zip(align(tables, chains), np.repeat(np.arange(len(data)), len(grid)), strict=True)
        scores, excess = zip(*(_held_out_score(a.boundary, cells[i]) for a, i in held_out), strict=True)
        mean = np.reshape(scores, (len(data), -1)).mean(0)
        if mean.max() > best:
            best, (weight, state_weight) = mean.max(), grid[mean.argmax()]
            scatter = np.reshape(excess, (len(data), len(grid), -1)).mean(0)[mean.argmax()]
            chosen = replace(learn(channels, shown, half), jitter=np.sqrt(np.maximum(scatter, 0.0)),
                             weight=weight, state_weight=state_weight)  # fmt: skip
    assert chosen is not None
    return chosen


def _shown(cells: np.ndarray) -> np.ndarray:
    """Labelled edges, -1 for the (equal) boundaries of a skipped subtask, which show nothing of their own."""
    equal = np.diff(cells) == 0
    return np.where(np.r_[equal, False] | np.r_[False, equal], -1, cells)


def _held_out_score(crossing: np.ndarray, cells: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean log posterior probability that boundaries are within a cell of their labels, and by boundary the
    squared deviation of the label from the posterior mean, in excess of the posterior variance [cells^2]."""
    index = np.arange(len(crossing))[:, None]
    near = (crossing * (np.abs(index - cells) <= 1)).sum(0)
    mean = (crossing * index).sum(0)
    excess = (mean - cells) ** 2 - (crossing * (index - mean) ** 2).sum(0)
    return float(np.log(near + FORGIVING).mean()), excess


def _fit_unlabelled(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap,
                    boundaries: list[np.ndarray]) -> SequenceModel:  # fmt: skip
    """Courses of all trials and what their changes may be, given the few labels there are."""
    values, num_states = [each.values for each in data], len(task.sequence)
    if num_states == 1:
        learner = Learner(values, task.sequence, optional_states(task, False))
        start = [np.ones((len(v), 1)) for v in values]
        return _finish(data, task, mapping, learner, *_converge(learner, start))
    factor = max(1, round(float(np.median([len(v) for v in values])) / COARSE_CELLS))
    known = [each.shares(b) for each, b in zip(data, boundaries, strict=True)]
    courses = find_courses([coarsen(v, factor) for v in values], num_states, known)
    namings = [naming(course, num_states, known) for course in courses]
    probability = probabilities(namings)
    choice = best_choice(courses, namings, probability)
    optional = optional_states(task, choice.settled)
    allowed = [label_constraints(d, b, len(optional)) for d, b in zip(data, boundaries, strict=True)]
    learner = Learner(values, task.sequence, optional, allowed=allowed)
    paths = [np.searchsorted(np.array(choice.ends) - 0.5, p.argmax(1))
             for p in _on_fine_grid(courses[choice.course], factor, values)]  # fmt: skip
    start = [np.eye(len(optional))[p] for p in paths]
    model = _finish(data, task, mapping, learner, *_converge(learner, start))
    order = [i for i in np.argsort(-probability) if probability[i] >= LEAST_PROBABLE][:MOST_KEPT]
    total = float(probability[order].sum())
    named = tuple(_name_course(values, known, courses[i], namings[i], float(probability[i]) / total, factor)
                  for i in order)  # fmt: skip
    scale = np.where(np.isfinite(boundaries).any(0), WEIGHING.labelled, WEIGHING.lag)
    lag = scale * float(np.median([len(v) for v in values]))
    return replace(model, courses=named, lag=lag, sure=choice.right)


def _converge(learner: Learner, start: list[np.ndarray]) -> tuple[StudentEmissions, list[np.ndarray]]:
    """EM at the finest scales, then posterior state probabilities under tempered emissions."""
    emissions, probability = learner.run(start, 1 / learner.stacked.shape[1], FLOORS[-2:])
    emissions = learner.tempered(emissions, probability)
    return emissions, [a.smoothed for a in learner.align(emissions, learner.law(probability))]


def _on_fine_grid(course: Course, factor: int, values: list[np.ndarray]) -> list[np.ndarray]:
    """Probabilities [(num_cells, num_stretches), ...] of a course's stretches, on the fine grid."""
    return [np.repeat(p, factor, axis=0)[: len(v)] for p, v in zip(course.probability, values, strict=True)]


def _name_course(values: list[np.ndarray], known: list[np.ndarray], course: Course, found: Naming,
           probability: float, factor: int) -> NamedCourse:  # fmt: skip
    """A course on the fine grid, with the mean lag of labels (as shares) behind each of its changes."""
    names = [f"{k}" for k in range(len(course.cost) - 1)]
    learner, stretches = Learner(values, names, [False] * len(names)), _on_fine_grid(course, factor, values)
    emissions = learner.tempered(learner.emissions(stretches, FLOORS[-1], 1.0), stretches)
    mean_cells = np.maximum(np.mean([p.sum(0) for p in stretches], 0), LEAST_CELLS)
    lags = np.array([(b[:, None] - ends) * len(v)
                     for v, b, ends in zip(values, known, course.ends, strict=True)])  # fmt: skip
    labelled = np.isfinite(lags)
    shift = np.where(labelled, lags, 0.0).sum(0) / np.maximum(labelled.sum(0), 1)
    return NamedCourse(probability, emissions, mean_cells, found.probability, shift)


def _fit_labelled(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap,
                  boundaries: list[np.ndarray]) -> SequenceModel:  # fmt: skip
    """Emissions learned from fully labelled trials align the others; then EM over all of them."""
    whole = [bool(np.isfinite(b).all()) for b in boundaries]
    paths = [np.searchsorted(b, d.middle, side="right") if labelled else None
             for d, b, labelled in zip(data, boundaries, whole, strict=True)]  # fmt: skip
    optional = optional_states(task, settled=False)
    own = [(d, b, path) for d, b, path in zip(data, boundaries, paths, strict=True) if path is not None]
    taught = Learner([d.values for d, _, _ in own], task.sequence, optional)
    probability = [np.eye(len(optional))[path] for _, _, path in own]
    emissions = taught.tempered(taught.emissions(probability, FLOORS[-1], 1.0), probability)
    law = taught.law(probability)
    mine = [d for d, _, _ in own], [b for _, b, _ in own], [path for _, _, path in own]
    detectors = choose_detectors(taught, *mine, temper=emissions.temper, law=law)
    allowed = [None if labelled else label_constraints(d, b, len(optional))
               for d, b, labelled in zip(data, boundaries, whole, strict=True)]  # fmt: skip
    learner = Learner([d.values for d in data], task.sequence, optional, known=paths, allowed=allowed)
    if len(own) < len(data):
        start = [np.eye(len(optional))[a.path] for a in learner.align(emissions, law, detectors)]
        start = learner.labelled(start)
        emissions, probability = learner.run(start, emissions.temper, FLOORS[-1:], detectors)
    return _finish(data, task, mapping, learner, emissions, probability, detectors)


def _finish(data: list[SequenceFeatures], task: SequenceTask, mapping: FeatureMap, learner: Learner,
            emissions: StudentEmissions, probability: list[np.ndarray],
            detectors: Detectors | None = None) -> SequenceModel:  # fmt: skip
    """The model, with the usual misfit of its own trials for comparison."""
    mean_cells, presence = durations(probability)
    typical = np.median([p.sum(0) for p in probability], 0)
    settled = learner.num_states > len(task.sequence)
    model = SequenceModel(task, mapping, emissions, mean_cells, presence, settled, detectors, typical)
    return replace(model, usual_scores=usual_misfit([model.misfit(each)[0] for each in data]))
