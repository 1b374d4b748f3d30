"""Segment trials of a plain ordered task: spans with boundary medians, deviations and intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hmmseg.errors import InputError
from hmmseg.hmm.alignment import Alignment
from hmmseg.hmm.chain import InfeasibleAlignment
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Failure, Segmentation, Span
from hmmseg.sequence import misfit as sequence_misfit
from hmmseg.sequence.features import Features, features
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.labels import boundary_probabilities
from hmmseg.sequence.model import SequenceModel, optional_states

SLOPE_DRAW = 0.75  # chosen: standard deviation of a boundary's shift, as a share of a slope's reach

_Boundary = tuple[float, float, tuple[float, float]]  # median, sd, 90 % interval


def segment_sequence(trials: Sequence[Trial], task: SequenceTask, model: SequenceModel | None = None,
                     seed: int = 0) -> list[Segmentation]:  # fmt: skip
    """One segmentation a trial; without a model, one is learned from these trials themselves.

    A trial that does not follow the task says so in `failed` and keeps its spans. A skipped optional
    subtask has no span. InputError where trials, task and model do not go together.
    """
    if model is None:
        model = fit_sequence(trials, task, seed=seed)
    elif model.task.sequence != task.sequence:
        raise InputError("model", f"was learned for {list(model.task.sequence)}",
                         f"the task's {list(task.sequence)}")  # fmt: skip
    return [_segment(trial, features(trial, model.mapping), model) for trial in trials]


def _segment(trial: Trial, data: Features, model: SequenceModel) -> Segmentation:
    try:
        alignment = model.align([data])[0]
    except InfeasibleAlignment as error:
        k = min(error.subtask, len(model.task.sequence) - 1)
        failed = Failure(k, model.task.sequence[k], None, f"has no samples left: {error.reason}")
        return Segmentation(trial.file, trial.rate, float("-inf"), (), failed, recorded=trial)
    return Segmentation(
        trial.file, trial.rate, alignment.log_evidence, _spans(trial, data, model, alignment),
        _failure(data, model, alignment), recorded=trial,
    )  # fmt: skip


def _failure(data: Features, model: SequenceModel, alignment: Alignment) -> Failure | None:
    names = model.task.sequence
    plain = alignment
    if model.detectors is not None:  # templates have no counterpart in free switching
        plain = type(model)(**{**vars(model), "detectors": None}).align([data])[0]
    return sequence_misfit.find_failure(
        names, optional_states(model.task, False), model.typical, model.misfit,
        model.emissions.log_likelihoods(data.values), model.mean_cells, plain,
    )  # fmt: skip


def _spans(trial: Trial, data: Features, model: SequenceModel, alignment: Alignment) -> tuple[Span, ...]:
    names = model.task.sequence
    visited = _visit_probabilities(alignment)[: len(names)]
    optional = optional_states(model.task, False)
    kept = [k for k in range(len(names)) if not optional[k] or visited[k] >= 0.5]
    crossing = boundary_probabilities(alignment)
    first, last = float(trial.t[0]), float(trial.t[-1])
    starts: list[_Boundary] = [(first, 0.0, (first, first))]
    for b, jitter in enumerate(_jitter(model)):
        if jitter > 0:
            crossing[:, b] = gaussian_filter1d(crossing[:, b], jitter, mode="constant")
    starts += [_boundary(data.edges, crossing[:, k - 1], first, last) for k in kept[1:]]
    ends = [*starts[1:], (last, 0.0, (last, last))]
    return tuple(
        Span(names[k], None, names[k], start[0], end[0], start[1], end[1], start[2], end[2])
        for k, start, end in zip(kept, starts, ends, strict=True)
    )


def _jitter(model: SequenceModel) -> np.ndarray:
    """Standard deviation [cells] by which each boundary scatters beyond its posterior.

    Measured on labels where there are any. Without, a smoothed slope reaches across a boundary by half
    its window and may draw it to either side; most of that reach is one standard deviation.
    """
    if model.detectors is not None:
        return model.detectors.jitter
    return np.full(model.emissions.loc.shape[0] - 1, SLOPE_DRAW * (model.mapping.window // 2 + 1))


def _visit_probabilities(alignment: Alignment) -> np.ndarray:
    """Probability (num_states,) that a path enters or starts in each state."""
    visited = np.exp(alignment.log_smoothed[0])
    for d, band in enumerate((alignment.log_advance, *alignment.log_skip), 1):
        visited[d:] += np.exp(band).sum(0)
    return visited


def _boundary(edges: np.ndarray, probability: np.ndarray, first: float, last: float) -> _Boundary:
    """Median, standard deviation and 90 % interval of a boundary [s].

    `probability` (num_cells - 1,) lies on the inner edges; each is spread evenly over one cell's
    width, as nothing is known within a cell. What is missing to 1 (a skipped subtask's boundary
    at the very start) lies at the first edge.
    """
    step = edges[1] - edges[0]
    middle = (edges[1:] + edges[:-1]) / 2
    cumulative = np.concatenate([[0.0], np.cumsum(probability)])
    total = max(cumulative[-1], np.finfo(float).tiny)
    low, median, high = np.interp([0.05, 0.5, 0.95], cumulative / total, middle)
    inner = edges[1:-1]
    mean = (probability * inner).sum() / total
    variance = (probability * (inner - mean) ** 2).sum() / total + step**2 / 12
    clip = lambda t: float(np.clip(t, first, last))  # noqa: E731
    return clip(median), float(np.sqrt(variance)), (clip(low), clip(high))
