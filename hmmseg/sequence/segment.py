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
from hmmseg.segmentation.spans import Failure, Place, Question, Segmentation, Span
from hmmseg.sequence import misfit as sequence_misfit
from hmmseg.sequence.features import Features, features
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.labels import boundary_probabilities
from hmmseg.sequence.model import SequenceModel, optional_states
from hmmseg.sequence.places import gains, mixed, places

SLOPE_DRAW = 0.75  # prior: standard deviation of a boundary's shift, as a share of a slope's reach

_Boundary = tuple[float, float, tuple[float, float]]  # median, sd, 90 % interval


def segment_sequence(trials: Sequence[Trial], task: SequenceTask,
                     model: SequenceModel | None = None) -> list[Segmentation]:  # fmt: skip
    """One segmentation a trial; without a model, one is learned from these trials themselves.

    A trial that does not follow the task says so in `failed` and keeps its spans. A skipped optional
    subtask has no span. Where trials can be read in several ways, spans have `alternatives` and the
    segmentation a `question`. InputError where trials, task and model do not go together.
    """
    if model is None:
        model = fit_sequence(trials, task)
    elif model.task.sequence != task.sequence:
        raise InputError("model", f"was learned for {list(model.task.sequence)}",
                         f"the task's {list(task.sequence)}")  # fmt: skip
    return [_segment(trial, features(trial, model.mapping), model) for trial in trials]


def _segment(trial: Trial, data: Features, model: SequenceModel) -> Segmentation:
    names = model.task.sequence
    readings, probability = [], []
    for p, reading in model.readings:
        try:
            alignment = reading.align([data])[0]
        except InfeasibleAlignment as error:
            if readings:
                continue
            k = min(error.subtask, len(names) - 1)
            failed = Failure(k, names[k], None, f"has no samples left: {error.reason}")
            return Segmentation(trial.file, trial.rate, float("-inf"), (), failed, recorded=trial)
        readings.append((alignment, _crossing(reading, alignment)))
        probability.append(p)
    first = readings[0][0]
    crossings = [crossing for _, crossing in readings]
    weights = np.array(probability) / np.sum(probability)
    spans = _spans(trial, data, model, first, weights, crossings)
    question = None
    if any(span.alternatives for span in spans):
        gain = gains(weights, crossings)
        question = Question(trial.file, names[int(gain.argmax()) + 1], float(gain.max()))
    return Segmentation(trial.file, trial.rate, first.log_evidence, spans, _failure(data, model, first),
                        recorded=trial, question=question)  # fmt: skip


def _failure(data: Features, model: SequenceModel, alignment: Alignment) -> Failure | None:
    names = model.task.sequence
    plain = alignment
    if model.detectors is not None:  # templates have no counterpart in free switching
        plain = type(model)(**{**vars(model), "detectors": None}).align([data])[0]
    return sequence_misfit.find_failure(
        names, optional_states(model.task, False), model.typical, model.misfit,
        model.emissions.log_likelihoods(data.values), model.mean_cells, plain,
    )  # fmt: skip


def _crossing(model: SequenceModel, alignment: Alignment) -> np.ndarray:
    """Probability (num_cells - 1, num_named - 1) that each boundary is at each edge, jitter included."""
    crossing = boundary_probabilities(alignment)[:, : len(model.task.sequence) - 1]
    for b, jitter in enumerate(_jitter(model)[: crossing.shape[1]]):
        if jitter > 0:
            crossing[:, b] = gaussian_filter1d(crossing[:, b], jitter, mode="constant")
    return crossing


def _spans(trial: Trial, data: Features, model: SequenceModel, alignment: Alignment,
           probability: np.ndarray, crossings: list[np.ndarray]) -> tuple[Span, ...]:  # fmt: skip
    """Spans where the first reading has them, as uncertain as all readings together."""
    names = model.task.sequence
    visited = _visit_probabilities(alignment)[: len(names)]
    optional = optional_states(model.task, False)
    kept = [k for k in range(len(names)) if not optional[k] or visited[k] >= 0.5]
    first, last = float(trial.t[0]), float(trial.t[-1])
    together = mixed(probability, crossings)
    starts: list[_Boundary] = [(first, 0.0, (first, first))]
    elsewhere: list[tuple[Place, ...]] = [()]
    for k in kept[1:]:
        each = [_boundary(data.edges, crossing[:, k - 1], first, last) for crossing in crossings]
        _, sd, (low, high) = _boundary(data.edges, together[:, k - 1], first, last)
        median = each[0][0]
        starts.append((median, sd, (min(low, median), max(high, median))))
        elsewhere.append(places([b[0] for b in each], [b[2] for b in each], probability.tolist()))
    ends = [*starts[1:], (last, 0.0, (last, last))]
    return tuple(
        Span(names[k], None, names[k], start[0], end[0], start[1], end[1], start[2], end[2], others)
        for k, start, end, others in zip(kept, starts, ends, elsewhere, strict=True)
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
    visited = alignment.smoothed[0].copy()
    for d, band in enumerate(alignment.moves, 1):
        visited[d:] += band.sum(0)
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
