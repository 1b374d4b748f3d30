"""Real and simulated trials of an ordered task, cut into the same subtasks, and the features that compare
them.

The slow course of a subtask is described by means over bins. What follows the event at its start (an impact,
a snap) has its own pace, so up to half a second after it is compared at equal times; the rest follows the
pace of the task and is compared at equal shares of the remaining subtask. Fluctuations have a clock of their
own (a structure rings at its frequency however slowly the robot moves), so their spectrum is taken in seconds
from the subtask's start, over a window that every trial fills. All features of a trial make one row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.integrate import cumulative_trapezoid

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align as align_blocks
from hmmseg.segmentation.posteriors import INTERVAL
from hmmseg.segmentation.spans import Segmentation, most_telling
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import SequenceModel
from hmmseg.sequence.segment import segment_sequence

BINS = 16  # chosen: bins of a subtask whose means are compared
EARLY = 6  # chosen: of these, the bins in the time right after its event
EVENT = 0.5  # chosen: s; that time, or a quarter of the shortest trial's subtask
SUB_BANDS = 8  # chosen: sub-bands of fast power, evenly spaced in log frequency
FEWEST = 3  # chosen: fewest DCT coefficients of a sub-band, and of a window's fast power
FLOOR = 1e-4  # numerics: rms over a channel's scale; keeps logarithms of power finite
SLOW, FAST, DURATION = range(3)
TASK_SPACE = ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")


@dataclass(frozen=True)
class Cut:
    """A trial and the edges (K + 1,) [s] of its K subtasks; it may go on after the last one."""

    trial: Trial
    edges: np.ndarray


@dataclass(frozen=True)
class Ensembles:
    """Cut trials of both kinds, the `channels` common to all, and the `subtasks` that every trial shows."""

    subtasks: tuple[str, ...]
    channels: tuple[str, ...]
    real: tuple[Cut, ...]
    sim: tuple[Cut, ...]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, cuts in (("real", self.real), ("simulated", self.sim)):
            if not cuts:
                raise InputError(f"{name} trials", "none shows the whole task", "at least one")
        if len(self.real) + len(self.sim) < 3:
            raise InputError("trials", "one real and one simulated",
                             "more of one kind at least: how trials scatter must be known")  # fmt: skip


def _cut(
    trials: Sequence[Trial], found: Sequence[Segmentation], warnings: list[str], seen: Sequence[str] = ()
) -> tuple[Cut, ...]:
    """Trials cut at their subtasks (`seen`: these alone); one that does not fit its task adds a warning."""
    out = []
    for trial, segmentation in zip(trials, found, strict=True):
        if not segmentation.complete:
            warnings.append(f"{trial.name}: does not fit its task and is left out")
            continue
        spans = [s for s in segmentation.spans if not seen or s.subtask in seen]
        out.append(Cut(trial, np.array([spans[0].start, *(s.end for s in spans)])))
    return tuple(out)


def align(
    real: Sequence[Trial],
    sim: Sequence[Trial],
    task: SequenceTask,
    model: SequenceModel | None = None,
    boundaries: Mapping[str, np.ndarray] | None = None,
) -> Ensembles:
    """Cut both kinds of trials into the subtasks of a plain ordered task.

    Args:
        real: Recorded trials.
        sim: Simulated trials.
        task: Their task.
        model: Emissions and durations. By default they are learned from all trials together, each channel
            standardised within its kind so that a bias or gain between the kinds displaces no boundary.
        boundaries: Boundaries [s] between the subtasks, by file, that replace the HMM's.

    Returns:
        The cut trials; those that do not fit the task are left out, with a warning.

    Raises:
        InputError: A kind has no complete trial, a trial lacks a channel, boundaries do not fit the task, or
            there are too few trials to estimate their scatter.
    """
    every, channels = [*real, *sim], _channels([*real, *sim], task)
    if boundaries is not None:
        cuts = [Cut(t, _edges(t, boundaries[t.file], task)) for t in every]
        return Ensembles(tuple(task.sequence), channels, tuple(cuts[: len(real)]), tuple(cuts[len(real) :]))
    both = [*_standardised(real, channels), *_standardised(sim, channels)] if model is None else every
    given = model or fit_sequence(both, SequenceTask(task.sequence, channels, task.optional))
    found = segment_sequence(both, given.task, given)
    shown = [{s.subtask for s in each.spans} for each in found if each.complete]
    seen = tuple(n for n in task.sequence if n not in task.optional or all(n in names for names in shown))
    warnings, n = list[str](), len(real)
    if most_telling(found) is not None:
        text = "boundaries could as well be elsewhere, and the gap with them: see hmmseg segment, and give a"
        warnings.append(f"{text} --model learned from labels")
    first, second = (_cut(every[part], found[part], warnings, seen) for part in (slice(n), slice(n, None)))
    return Ensembles(seen, channels, first, second, tuple(warnings))


def align_block_trials(real: Sequence[Trial], sim: Sequence[Trial], task: BlockTask, rig: Rig) -> Ensembles:
    """Cut trials of a block task at contact changes, each kind aligned by its own fit.

    Args:
        real: Recorded trials.
        sim: Simulated trials.
        task: Their task.
        rig: The nominal hand of both.

    Returns:
        The cut trials, in the channels of task space.

    Raises:
        InputError: A kind has no trial that shows the whole task.
    """
    kinds, warnings, names = [], list[str](), ()
    for trials in (real, sim):
        aligned = align_blocks(trials, task, rig).trials
        signals = [{c: np.asarray(getattr(a.signals, c)) for c in ("t", *TASK_SPACE)} for a in aligned]
        moved = [Trial(a.trial.file, s.pop("t"), s) for a, s in zip(aligned, signals, strict=True)]
        found = [a.segmentation for a in aligned]
        kinds.append(_cut(moved, found, warnings))
        if not kinds[-1]:
            raise InputError(trials[0].file, "does not fit its task", "a recording that shows every subtask")
        names = next(tuple(s.label for s in each.spans) for each in found if each.complete)
    return Ensembles(names, TASK_SPACE, kinds[0], kinds[1], tuple(warnings))


def _edges(trial: Trial, inner: np.ndarray, task: SequenceTask) -> np.ndarray:
    """Edges (K + 1,) [s] of the subtasks from the boundaries that are given for a trial."""
    edges = np.concatenate([trial.t[:1], np.asarray(inner, float), trial.t[-1:]])
    if edges.size != len(task.sequence) + 1 or not (np.diff(edges) > 0).all():
        raise InputError(f"boundaries of {trial.file}", f"found {np.asarray(inner).tolist()}",
                         f"{len(task.sequence) - 1} increasing times within the trial")  # fmt: skip
    return edges


def _channels(trials: Sequence[Trial], task: SequenceTask) -> tuple[str, ...]:
    """The channels to compare: the task's, or all that the trials share."""
    names = task.channels or tuple(n for n in trials[0].channels if all(n in t.channels for t in trials))
    for trial in trials:
        for name in names:
            if name not in trial.channels:
                raise InputError(f"{trial.file}: column {name}", "missing", ", ".join(names))
    if not names:
        raise InputError(trials[0].file, "shares no channel with the other trials", "a common column")
    return names


def _standardised(trials: Sequence[Trial], channels: tuple[str, ...]) -> list[Trial]:
    """Trials with every channel at median 0, in units of the range of its central 90 %, over all of them."""
    out: list[dict[str, np.ndarray]] = [{} for _ in trials]
    for name in channels:
        values = np.concatenate([t.channels[name] for t in trials])
        low, middle, high = np.nanquantile(values, (INTERVAL[0], 0.5, INTERVAL[1]))
        for k, trial in enumerate(trials):
            out[k][name] = (trial.channels[name] - middle) / (high - low or 1.0)
    return [Trial(t.file, t.t, columns) for t, columns in zip(trials, out, strict=True)]


@dataclass(frozen=True)
class Layout:
    """What each of the F features of a trial is: arrays (F,) of its `channel` (-1: a duration), `subtask`,
    `kind` (SLOW, FAST, DURATION) and `width` (number of DCT coefficients in a power).

    Of K subtasks: the time `event` (K,) [s] after the start that is compared at equal times (0 for the first,
    which begins with the recording), the `window` (K,) of fast power in samples, the `coefficients` (slices
    of the window's DCT, one per sub-band) and the number of `bins` (K,) of the slow course. `scale` (C,) are
    the channels' spreads, `rate` [Hz] is common to all trials.
    """

    ensembles: Ensembles
    rate: float
    scale: np.ndarray
    event: np.ndarray
    window: np.ndarray
    coefficients: tuple[tuple[slice, ...], ...]
    bins: np.ndarray
    channel: np.ndarray
    subtask: np.ndarray
    kind: np.ndarray
    width: np.ndarray

    @property
    def least(self) -> np.ndarray:
        """Power (C,) below which a channel's counts as none."""
        return (FLOOR * self.scale) ** 2

    @property
    def every(self) -> tuple[int, ...]:
        """All channels, then -1 for durations."""
        return (*range(len(self.ensembles.channels)), -1)

    def of_channel(self, channel: int) -> np.ndarray:
        """Indices of a channel's features, slow ones of all subtasks before fast ones (-1: durations)."""
        return np.flatnonzero(self.channel == channel)


def layout(given: Ensembles) -> Layout:
    """The features common to all trials. Kinds recorded at different rates are compared at the lower one."""
    rate = min(float(np.median([c.trial.rate for c in kind])) for kind in (given.real, given.sim))
    durations = np.array([np.diff(c.edges) for c in (*given.real, *given.sim)])
    shortest = durations.min(0)
    spread = np.zeros(len(given.channels))
    for kind in (given.real, given.sim):
        values = [np.concatenate([c.trial.channels[n] for c in kind]) for n in given.channels]
        spread = np.maximum(spread, [np.subtract(*np.nanquantile(v, INTERVAL[::-1])) for v in values])
    event = np.minimum(EVENT, shortest / 4)
    event[(np.arange(event.size) == 0) | (event * rate < 2 * EARLY)] = 0.0
    window = (shortest * rate).astype(int)
    bins = np.clip(shortest * rate // 4, 1, BINS).astype(int)
    subs = tuple(_sub_bands(int(low), int(n)) for low, n in zip(bins, window, strict=True))
    rows, every = [], range(len(given.subtasks))
    for c in range(len(given.channels)):
        rows += [(c, k, SLOW, 1) for k in every for _ in range(bins[k])]
        rows += [(c, k, FAST, s.stop - s.start) for k in every for s in subs[k]]
    rows += [(-1, k, DURATION, 1) for k in every]
    scale = np.where(spread > 0, spread, 1.0)
    return Layout(given, rate, scale, event, window, subs, bins, *np.array(rows).T)


def bin_edges(given: Layout, edges: np.ndarray) -> np.ndarray:
    """Edges (sum of `bins` + 1,) [s] of all bins of subtasks between `edges` (K + 1,) [s]."""
    out = [edges[:1]]
    for start, end, count, early in zip(edges, edges[1:], given.bins, given.event, strict=False):
        if not early or count < BINS:
            out.append(np.linspace(start, end, count + 1)[1:])
        else:
            out.append(np.linspace(start, start + early, EARLY + 1)[1:])
            out.append(np.linspace(start + early, end, count - EARLY + 1)[1:])
    return np.concatenate(out)


def _sub_bands(low: int, window: int) -> tuple[slice, ...]:
    """Up to SUB_BANDS slices of the DCT coefficients from `low` on, each with at least FEWEST."""
    if window - low < FEWEST:
        return ()
    out, start = [], low
    for edge in np.geomspace(low, window, SUB_BANDS + 1)[1:]:
        stop = round(edge)
        if window - stop < FEWEST:  # the rest would be too narrow
            out.append(slice(start, window))
            break
        if stop - start >= FEWEST:
            out.append(slice(start, stop))
            start = stop
    return tuple(out)


def resampled(t: np.ndarray, values: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    """Resample a signal with gaps at `times` (n,) [s]: averaged if sampled much faster, else interpolated."""
    known = np.isfinite(values)
    if 1 / np.median(np.diff(t)) < 1.5 * rate:
        return np.interp(times, t[known], values[known])
    return means(t[known], values[known], times[:, None] + np.array([-0.5, 0.5]) / rate)[:, 0]


def means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means of a linearly interpolated signal between neighbouring edges [s] (along the last axis)."""
    total = cumulative_trapezoid(values, t, initial=0)
    # Between samples the integral of a straight line is a parabola.
    k = np.clip(np.searchsorted(t, edges, side="right") - 1, 0, t.size - 2)
    w = edges - t[k]
    slope = (values[k + 1] - values[k]) / (t[k + 1] - t[k])
    integral = total[k] + w * (values[k] + 0.5 * w * slope)
    return np.diff(integral) / np.diff(edges)


def transformed(values: np.ndarray) -> np.ndarray:
    """Orthonormal DCT (..., n) of windows (..., n) minus their straight lines.

    The square of every coefficient of white noise has its variance as expectation.
    """
    n = values.shape[-1]
    at = np.arange(n) - (n - 1) / 2
    slope = (values @ at) / max(at @ at, 1.0)
    return np.asarray(dct(values - values.mean(-1, keepdims=True) - slope[..., None] * at, norm="ortho"))


def windowed(
    given: Layout, cut: Cut, channel: int, subtask: int, values: np.ndarray | None = None
) -> np.ndarray:
    """Samples (window,) of a channel, or of other `values` at its times, from a subtask's start on."""
    n, t = int(given.window[subtask]), cut.trial.t
    if values is None:
        values = cut.trial.channels[given.ensembles.channels[channel]]
    first = int(np.searchsorted(t, cut.edges[subtask] - 0.5 / given.rate))
    inside = slice(first, first + n)
    times = cut.edges[subtask] + (np.arange(n) + 0.5) / given.rate
    # Recorded samples are kept where they fit: interpolation would smooth the noise.
    if first <= t.size - n and np.isfinite(values[inside]).all():
        off = (t[inside] - t[first]) * given.rate - np.arange(n)
        if np.abs(off).max() < 0.75:
            return values[inside]
    return resampled(t, values, np.clip(times, t[0], t[-1]), given.rate)


def powers(
    given: Layout, cuts: Sequence[Cut], channel: int, values: Sequence[np.ndarray | None] | None = None
) -> np.ndarray:
    """Mean powers (num_cuts, num_bands) of all subtasks' sub-bands in a channel, or in other `values`."""
    out, every = [np.zeros((len(cuts), 0))], [None] * len(cuts) if values is None else values
    for k, own in enumerate(given.coefficients):
        if own:
            each = [windowed(given, c, channel, k, v) for c, v in zip(cuts, every, strict=True)]
            power = transformed(np.array(each)) ** 2
            starts = [s.start for s in own]  # each ends where the next begins, the last with the window
            out.append(np.add.reduceat(power, starts, 1) / np.diff([*starts, own[-1].stop]))
    return np.concatenate(out, 1)


def features(given: Layout, cut: Cut) -> np.ndarray:
    """All features (F,) of a trial: bin means in the channel's unit, log powers, log durations."""
    out, edges = np.zeros(given.kind.size), bin_edges(given, cut.edges)
    out[given.of_channel(-1)] = np.log(np.diff(cut.edges))
    for c, name in enumerate(given.ensembles.channels):
        values = cut.trial.channels[name]
        known = np.isfinite(values)
        course, power = means(cut.trial.t[known], values[known], edges), powers(given, [cut], c)[0]
        out[given.of_channel(c)] = np.concatenate([course, np.log(power + given.least[c])])
    return out


def both(given: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Features of the real trials (R, F) and of the simulated ones (S, F)."""
    real, sim = ([features(given, c) for c in kind] for kind in (given.ensembles.real, given.ensembles.sim))
    return np.array(real), np.array(sim)
