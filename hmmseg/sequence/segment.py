"""Segment trials of a plain ordered task: spans with boundary medians, deviations and intervals.

Where trials can be aligned and read in several ways, the posterior of a boundary is the mixture over courses
and their changes, weighted by the probabilities of the courses and that the boundary is that change. It also
shows which label would tell most.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import entr

from hmmseg.errors import InputError
from hmmseg.hmm.chain import InfeasibleAlignment
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Failure, Place, Question, Segmentation, Span
from hmmseg.sequence.courses import NEAR, WEIGHING
from hmmseg.sequence.features import SequenceFeatures, features
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import NamedCourse, SequenceModel, optional_states

LISTED = 0.05  # chosen: least probability of a place that is listed
SURE = 1 - LISTED  # probability from which one place is the answer, as no other can be listed
FARTHEST = 8.0  # numerics: reach of a Laplace law, in its scales
LEAST = 1e-3  # numerics: probability of a naming below which it is neglected
EXACT = 1e-6  # numerics: least noise of a level, as a share of a feature's spread


def mix(crossings: Sequence[np.ndarray], courses: Sequence[NamedCourse],
        lag: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Mixture over all courses of `crossings` [(num_cells - 1, num_changes), ...], the posterior of each.

    `lag` (num_boundaries,) [cells]. Returns the posterior (num_cells - 1, num_boundaries) of each boundary at
    each cell edge, and the expected gain (num_boundaries,) [nats] of a label: the mutual information of
    naming and label, which is the entropy of the mixture less the mean entropy of its components."""
    from scipy.ndimage import convolve1d, shift  # slow to import

    mixture, gain = [], []
    for b, scale in enumerate(lag):
        parts, weights = [], []
        for crossing, course in zip(crossings, courses, strict=True):
            weight = course.probability * course.naming[b]
            for j in np.flatnonzero(course.naming[b] > LEAST):
                moved = crossing[:, j]
                if course.shift[b, j]:
                    moved = shift(moved, course.shift[b, j], order=1)
                parts.append(moved)
                weights.append(weight[j])
        reach = int(np.ceil(FARTHEST * scale))
        law = np.exp(-np.abs(np.arange(-reach, reach + 1)) / max(scale, 1e-9))
        table = convolve1d(np.array(parts), law / law.sum(), axis=1, mode="constant")
        table /= np.maximum(table.sum(1, keepdims=True), np.finfo(float).tiny)
        p = np.array(weights) / np.sum(weights)
        mixed = p @ table
        gain.append(max(float(entr(mixed).sum() - p @ entr(table).sum(1)), 0.0))
        mixture.append((1 - WEIGHING.elsewhere) * mixed + WEIGHING.elsewhere / len(mixed))
    return np.array(mixture).T, np.array(gain)


def places(edges: np.ndarray, crossing: np.ndarray, answer: float) -> tuple[Place, ...]:
    """Places [s] of one boundary, most probable first; none where one is SURE. `crossing` (num_cells - 1,):
    its probability at the inner `edges` (num_cells + 1,) [s]; `answer`: the first place."""
    inner, left = edges[1:-1], crossing / crossing.sum()
    reach = NEAR * (edges[-1] - edges[0])
    low = np.searchsorted(inner, inner - reach)
    high = np.searchsorted(inner, inner + reach, side="right")
    found, time = [], answer
    while True:
        here = np.abs(inner - time) <= reach
        found.append(Place(float(time), float(left[here].sum())))
        left = np.where(here, 0.0, left)
        total = np.concatenate([[0.0], np.cumsum(left)])
        window = total[high] - total[low]
        peak = int(window.argmax())
        if window[peak] < LISTED:
            break
        middle = (total[low[peak]] + total[high[peak]]) / 2
        time = inner[np.searchsorted(total[1:], middle)]
    found.sort(key=lambda place: -place.probability)
    if found[0].probability >= SURE or len(found) == 1:
        return ()
    return tuple(place for place in found if place.probability >= LISTED)


MAIN = 0.5  # chosen: least probability near a median for it to be reported, rather than lie between places

_Boundary = tuple[float, float, tuple[float, float]]  # median, sd, 90 % interval


def segment_sequence(trials: Sequence[Trial], task: SequenceTask,
                     model: SequenceModel | None = None) -> list[Segmentation]:  # fmt: skip
    """Segment recordings of a plain ordered task.

    Args:
        trials: recordings.
        task: the order of the subtasks.
        model: from `fit_sequence`; by default learned from these trials themselves.

    Returns:
        One segmentation a trial. A trial that does not follow the task says so in `failed` and keeps its
        spans. A skipped optional subtask has no span. Where trials can be read in several ways, spans have
        `alternatives` and the segmentation a `question`.

    Raises:
        InputError: trials, task and model do not go together.
    """
    if model is None:
        model = fit_sequence(trials, task)
    elif model.task.sequence != task.sequence:
        raise InputError("model", f"was learned for {list(model.task.sequence)}",
                         f"the task's {list(task.sequence)}")  # fmt: skip
    return [_segment(trial, features(trial, model.mapping), model) for trial in trials]


def _segment(trial: Trial, data: SequenceFeatures, model: SequenceModel) -> Segmentation:
    names = model.task.sequence
    try:
        alignment = model.align(data)
        crossing, gain = _posterior(data, model, alignment)
    except InfeasibleAlignment as error:
        k = min(error.subtask, len(names) - 1)
        failed = Failure(k, names[k], None, f"has no samples left: {error.reason}")
        return Segmentation(trial.file, trial.rate, float("-inf"), (), failed, recorded=trial)
    spans = _spans(trial, data, model, alignment, crossing)
    question = None
    if any(span.alternatives for span in spans):
        question = Question(trial.file, names[int(gain.argmax()) + 1], float(gain.max()))
    return Segmentation(trial.file, trial.rate, alignment.log_evidence, spans, model.failure(data),
                        recorded=trial, question=question)  # fmt: skip


def _posterior(data: SequenceFeatures, model: SequenceModel,
               alignment: AlignmentPosterior) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """As from `mix`, from the model's courses where it has any, else from its own alignment."""
    if model.courses:
        return mix([course.align(data).moves[0] for course in model.courses], model.courses, model.lag)
    crossing = alignment.boundary[:, : len(model.task.sequence) - 1].copy()
    if model.detectors is not None:
        for b in np.flatnonzero(model.detectors.jitter > 0):
            crossing[:, b] = gaussian_filter1d(crossing[:, b], model.detectors.jitter[b], mode="constant")
    return crossing, np.zeros(crossing.shape[1])


def _spans(trial: Trial, data: SequenceFeatures, model: SequenceModel, alignment: AlignmentPosterior,
           posterior: np.ndarray) -> tuple[Span, ...]:  # fmt: skip
    """Spans at the model's own boundaries, with the uncertainty of the mixture over courses."""
    names, optional = model.task.sequence, optional_states(model.task, False)
    visited = alignment.smoothed[0].copy()  # probability that a path visits each state
    for d, band in enumerate(alignment.moves, 1):
        visited[d:] += band.sum(0)
    kept = [k for k in range(len(names)) if not optional[k] or visited[k] >= 0.5]
    first, last, step = float(trial.t[0]), float(trial.t[-1]), float(data.edges[1] - data.edges[0])
    found, dated = [], []
    for k in kept[1:]:
        crossing, scattered = posterior[:, k - 1], bool(model.courses)
        found.append(_boundary(data.edges, crossing, first, last, scattered))
        dated.append(found[-1][0])
        if scattered:
            here = np.abs(data.edges[1:-1] - dated[-1]) <= NEAR * (data.edges[-1] - data.edges[0])
            if crossing[here].sum() / crossing.sum() < MAIN:
                dated[-1] = _boundary(data.edges, alignment.boundary[:, k - 1], first, last)[0]
    if model.courses and not any(course.shift[k - 1].any() for course in model.courses for k in kept[1:]):
        dated = _jumps(trial, data, model, dated)
    starts: list[_Boundary] = [(first, 0.0, (first, first))]
    elsewhere: list[tuple[Place, ...]] = [()]
    for number, (k, median, (_, sd, (low, high))) in enumerate(zip(kept[1:], dated, found, strict=True), 1):
        # As in every alignment, a state that occurs lasts at least a cell; medians alone do not ensure that.
        median = max(starts[-1][0] + step, min(median, last - step * (len(kept) - number)))
        starts.append((median, sd, (min(low, median), max(high, median))))
        elsewhere.append(places(data.edges, posterior[:, k - 1], median) if model.courses else ())
    ends = [*starts[1:], (last, 0.0, (last, last))]
    return tuple(
        Span(names[k], None, names[k], start[0], end[0], start[1], end[1], start[2], end[2], others)
        for k, start, end, others in zip(kept, starts, ends, elsewhere, strict=True)
    )


def _jumps(trial: Trial, data: SequenceFeatures, model: SequenceModel, times: list[float]) -> list[float]:
    """When [s] the channels jump near the changes `times` of the features.

    The offset from a feature's change follows the Laplace law of `Weighing.lag`, NEAR at most; between jumps
    levels are constant with normal noise. All jumps are found jointly on the cells, as neighbours share
    samples, and each is then refined between two samples."""
    step, cells = model.mapping.step, len(data.values)
    farthest = max(round(NEAR * cells), 1)
    reach, channels = farthest + model.mapping.window, len(model.mapping.channels)
    at = np.clip(((np.array(times) - data.edges[0]) / step).astype(int), 1, cells - 2)
    found: list[int] = []
    for group in np.split(np.arange(at.size), np.flatnonzero(np.diff(at) > 2 * reach) + 1):
        if group.size:
            low = max(at[group[0]] - reach, found[-1] + 1 if found else 0)
            high = min(at[group[-1]] + reach, *at[group[-1] + 1 :], cells)
            x = data.values[low:high, :channels]
            found += (low + _levels(x, at[group] - low, farthest, WEIGHING.lag * cells, model)).tolist()
    middle = [float(data.edges[n] + step / 2) for n in found]
    ends = [float(trial.t[0]), *middle, float(trial.t[-1])]
    return [_jump(trial, model, *ends[b : b + 3]) for b in range(len(found))]


def _levels(x: np.ndarray, at: np.ndarray, farthest: int, lag: float, model: SequenceModel) -> np.ndarray:
    """The cells, each within `farthest` of its start in `at`, in which the level of `x` most likely changes.
    `x` (num_cells, num_channels). A cell in which the level changes counts for neither side."""
    there, x = _about_mean(x)
    sums = [np.concatenate([np.zeros((1, x.shape[1])), v.cumsum(axis=0)]) for v in (there, x, x**2)]

    def rest(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Residual sums of squares about the level of the cells from low + 1 up to high."""
        count, first, second = (v[high] - v[np.minimum(low + 1, high)] for v in sums)
        return second - first**2 / np.maximum(count, 1)

    every = [np.arange(max(n - farthest, 1), min(n + farthest, len(x) - 2) + 1) for n in at]
    if not all(each.size for each in every):
        return at
    found = at
    for _ in range(2):  # the noise is estimated from the previous changes
        ends = np.r_[-1, found, len(x)]
        noise = rest(ends[:-1], ends[1:]).sum(axis=0) / np.maximum(sums[0][-1], 1) + EXACT**2
        weight = model.emissions.temper / (2 * noise)
        total, source = rest(np.full_like(every[0], -1), every[0]) @ weight, []
        for b, each in enumerate(every):
            if b:
                low, high = np.meshgrid(every[b - 1], each, indexing="ij")
                cost = np.where(high > low + 1, rest(low, high) @ weight, np.inf) + total[:, None]
                source.append(cost.argmin(axis=0))
                total = cost.min(axis=0)
            total = total + np.abs(each - at[b]) / lag
        if not np.isfinite(total).any():  # too few cells for all states
            return at
        path = [int((total + rest(every[-1], np.full_like(every[-1], len(x))) @ weight).argmin())]
        for back in reversed(source):
            path.append(int(back[path[-1]]))
        found = np.array([each[n] for each, n in zip(every, path[::-1], strict=True)])
    return found


def _about_mean(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which values (n, k) are there, and the values about their column means, 0 where missing."""
    there = np.isfinite(x)
    x = np.where(there, x, 0.0)
    return there, np.where(there, x - x.sum(axis=0) / np.maximum(there.sum(axis=0), 1), 0.0)


def _jump(trial: Trial, model: SequenceModel, before: float, time: float, after: float) -> float:
    """Posterior median of the jump [s] within 1.5 cells of `time`, between any two samples."""
    step = model.mapping.step
    reach = model.mapping.window * step
    inside = slice(*np.searchsorted(trial.t, [max(before, time - reach), min(after, time + reach)]))
    x = np.stack([trial.channels[name][inside] for name in model.mapping.channels], axis=1)
    between = (trial.t[inside][1:] + trial.t[inside][:-1]) / 2
    open_ = np.abs(between - time) <= 1.5 * step
    if not open_.any():
        return time
    there, x = _about_mean(x)
    count, first = there.cumsum(axis=0), x.cumsum(axis=0)
    left, right = count[:-1], count[-1] - count[:-1]
    explained = first[:-1] ** 2 / np.maximum(left, 1) + (first[-1] - first[:-1]) ** 2 / np.maximum(right, 1)
    total = (x**2).sum(axis=0)
    rest = np.maximum(total - explained, 1e-9 * total) + np.finfo(float).tiny
    cost = model.emissions.temper * (count[-1] / 2 * np.log(rest)).sum(axis=1)[open_]
    weight = np.exp(cost.min() - cost).cumsum()
    return float(between[open_][np.searchsorted(weight, weight[-1] / 2)])


def _boundary(
    edges: np.ndarray, probability: np.ndarray, first: float, last: float, scattered: bool = False
) -> _Boundary:
    """Median, standard deviation and 90 % interval of a boundary [s].

    `probability` (num_cells - 1,) of the inner edges is spread evenly over one cell's width, and what is
    missing to 1 (a skipped subtask's boundary at the very start) lies at the first edge. Where the boundary
    may lie in places far apart (`scattered`), the interval is the shortest, not that of equal tails."""
    middle, inner = (edges[1:] + edges[:-1]) / 2, edges[1:-1]
    cumulative = np.r_[0.0, np.cumsum(probability)]
    total = max(cumulative[-1], np.finfo(float).tiny)
    low, median, high = np.interp([0.05, 0.5, 0.95], cumulative / total, middle)
    if scattered:
        low, high = _shortest(middle, cumulative / total)
    mean = probability @ inner / total
    variance = probability @ (inner - mean) ** 2 / total + (edges[1] - edges[0]) ** 2 / 12
    low, median, high = np.clip([low, median, high], first, last).tolist()
    return median, float(np.sqrt(variance)), (low, high)


def _shortest(middle: np.ndarray, cumulative: np.ndarray) -> tuple[float, float]:
    """The shortest interval between two of the times `middle` that holds 90 % of the probability."""
    stop = np.searchsorted(cumulative, cumulative + 0.9)
    start = np.flatnonzero(stop < middle.size)
    shortest = start[np.argmin(middle[stop[start]] - middle[start])]
    return float(middle[shortest]), float(middle[stop[shortest]])
