"""Labelled boundaries: checked, put on the grid, and used to choose the boundary detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.sequence.detectors import Detectors, learn
from hmmseg.sequence.emissions import from_weights
from hmmseg.sequence.features import SequenceFeatures
from hmmseg.sequence.model import jumps
from hmmseg.sequence.transitions import Transitions

Labels = Mapping[str, Any]  # a trial's name and what is known of its boundaries [s], checked here
HALVES = (0.0075, 0.02, 0.05)  # prior: half a window, as a share of a trial's length
WEIGHTS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)  # prior: of templates; held-out labels choose
STATE_WEIGHTS = (0.03, 0.2, 1.0)  # prior: of the emissions beside them, likewise
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
                     law: Transitions) -> Detectors | None:  # fmt: skip
    """Detectors whose window and weights place held-out labels best (each trial left out once).

    The score is the log probability of the labelled cell edge and its neighbours, so weights that
    make boundaries overconfident lose. None for a single subtask. One labelled trial cannot be left
    out: then the middle window with the emissions' own share of independent observations.
    """
    num_states = len(law.log_initial)
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
              law: Transitions) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Mean log probability of held-out labels for every pair of weights, and their extra scatter.

    The scatter (num_weights, num_state_weights, num_boundaries) [cells] is what the squared
    differences from the posterior means exceed the posterior variances by.
    """
    parts = []
    for i in range(len(values)):
        rest = [j for j in range(len(values)) if j != i]
        onehot = np.eye(len(law.log_initial))[np.concatenate([paths[j] for j in rest])]
        emissions = from_weights(np.vstack([values[j] for j in rest]), onehot, floor, temper)
        detectors = learn([channels[j] for j in rest], [shown(cells[j]) for j in rest], half)
        ll, ratios = emissions.log_likelihoods(values[i]), detectors.log_ratios(channels[i])
        parts += [(s * ll, jumps(ratios, replace(detectors, weight=w), law.bands))
                  for w in WEIGHTS for s in STATE_WEIGHTS]  # fmt: skip
    aligned = align([p[0] for p in parts], [law.chain(p[1]) for p in parts])
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
