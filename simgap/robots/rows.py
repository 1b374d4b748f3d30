"""The rows that are compared: averages of neighbouring samples, their noise, their folds and their phases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hmmseg.errors import InputError
from hmmseg.robust import white_sd
from simgap.robots.windows import FLIES, REGIMES, Window, moves, reaches
from simgap.simulators.protocol import Channels, Simulator
from simgap.simulators.recording import Recording

if TYPE_CHECKING:
    from hmmseg.io.task import AnyTask

FOLDS = 6  # numerics: parts that are held out in turn; each fit keeps five sixths
RATE_LIMIT = 100.0  # chosen: Hz: samples are averaged down to this rate


@dataclass(frozen=True)
class Rows:
    """N rows, ordered by window, then time, then channel.

    `channels`: names of the compared channels; `log`, `channel`, `window`, `regime`: number (N,) of each
    row's log, channel, window and window's regime; `time`: times (N,) [s]; `since`: times (N,) [s] since the
    window is run; `observed`: recorded values (N,) in the channel's unit; `variance`: variance (N,)
    of their sensor noise; `of`: the rows of each window.
    """

    channels: tuple[str, ...]
    log: np.ndarray
    channel: np.ndarray
    window: np.ndarray
    time: np.ndarray
    since: np.ndarray
    regime: np.ndarray
    observed: np.ndarray
    variance: np.ndarray
    of: tuple[slice, ...]
    _averages: tuple[_Averages, ...]

    def averaged(self, read: Sequence[Channels | None]) -> np.ndarray:
        """Rows (N,) of simulated channels by window; NaN where a rollout diverged."""
        out = np.full(self.log.size, np.nan)
        for average, mine, channels in zip(self._averages, self.of, read, strict=True):
            if channels is not None and mine.stop > mine.start:
                out[mine] = average(np.array([channels[name] for name in self.channels]))
        return out

    def rms(self, residual: np.ndarray, among: np.ndarray | None = None) -> dict[str, float]:
        """Root mean square of a residual (N,) by channel, over the rows `among` (N,) where given."""
        out = {}
        for c, name in enumerate(self.channels):
            mine = (self.channel == c) & (True if among is None else among)
            if mine.any():
                out[name] = float(np.sqrt(np.mean(residual[mine] ** 2)))
        return out


@dataclass(frozen=True)
class _Averages:
    """Averages over groups of samples: the first sample of each group, which samples are finite (C, n), and
    how many of them each group has (C, groups)."""

    first: np.ndarray
    finite: np.ndarray
    count: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Averages (rows,) of values (C, n); a group without a finite sample has no row."""
        total = np.add.reduceat(np.where(self.finite, values, 0.0), self.first, axis=1)
        return (total / np.maximum(self.count, 1)).T[(self.count > 0).T]


def rows_of(recordings: Sequence[Recording], windows: Sequence[Window], noise: Mapping[str, float]) -> Rows:
    """The rows of all windows.

    Args:
        recordings: The logs.
        windows: Their windows.
        noise: Standard deviation of one sample by channel [its unit].

    Raises:
        InputError: There is no sample at all.
    """
    names, sd = tuple(noise), np.array([*noise.values()])
    averages, parts, of, at = [], [], [], 0
    for number, window in enumerate(windows):
        log = recordings[window.log].window(window.begin, window.end)
        begun, span = recordings[window.log].t[window.first], max(float(log.t[-1] - log.t[0]), 1e-9)
        size = max(1, round(len(log) / max(span * RATE_LIMIT, 1.0)))
        first, values = np.arange(0, len(log), size), np.array([log[n] for n in names])
        finite = np.isfinite(values)
        average = _Averages(first, finite, np.add.reduceat(finite.astype(int), first, axis=1))
        stamps = np.add.reduceat(log.t, first) / np.diff(np.append(first, len(log)))
        group, channel = np.nonzero(average.count.T)
        variance, n = sd[channel] ** 2 / average.count[channel, group], group.size
        of_window = np.full(n, window.log), channel, np.full(n, number), stamps[group]
        parts.append((*of_window, stamps[group] - begun, average(values), variance))
        averages.append(average)
        of.append(slice(at, at + n))
        at += n
    if at == 0:
        raise InputError("recordings", "have no samples of the channels to compare", "numbers")
    log, channel, window, time, since, observed, variance = map(np.concatenate, zip(*parts, strict=True))
    regime = np.array([REGIMES.index(w.regime) for w in windows])[window]
    columns = log, channel, window, time, since, regime, observed, variance
    return Rows(names, *columns, tuple(of), tuple(averages))


def folds_of(rows: Rows, num_logs: int, groups: Sequence[int] | None = None) -> np.ndarray:
    """The fold (N,) of each row: whole logs in turn, or stretches of windows where there are one or two logs.

    With `groups` (num_logs,), logs of the same number are held out together.
    """
    if groups is not None:
        return np.unique(np.asarray(groups)[rows.log], return_inverse=True)[1]
    if num_logs >= 3:
        return rows.log % min(num_logs, FOLDS)
    stretches = max(2, FOLDS // num_logs)
    out = np.zeros(rows.log.size, int)
    for log in range(num_logs):
        mine = rows.log == log
        window = rows.window[mine]
        first, count = int(window.min()), int(np.ptp(window)) + 1
        out[mine] = log * stretches + (window - first) * stretches // count
    return np.unique(out, return_inverse=True)[1]


# Sensor noise of each channel: as stated, or estimated from differences; never below the resolution's.

ORDERS = (2, 4)  # numerics: of differences: the second is less noisy, the fourth blinder to motion


def resolution(values: np.ndarray) -> float:
    """The step of which all distances between values (n,) are multiples; 0 where there is none."""
    distinct = np.unique(np.round(values[np.isfinite(values)], 9))
    if distinct.size < 3:
        return 0.0
    gaps = np.diff(distinct)
    step = float(gaps.min())
    multiples = gaps / step
    away = np.abs(multiples - np.round(multiples))
    return step if np.quantile(away, 0.95) < 0.05 else 0.0


def estimate_noise(recordings: Sequence[Recording], name: str, step: float = 0.0) -> float:
    """Robust standard deviation of a channel's white noise from its differences; read in steps of `step`.

    Motion only adds to differences, so the least over ORDERS counts: a second difference is blind to straight
    lines, a fourth to cubics.
    """
    values = np.concatenate([r[name][np.isfinite(r[name])] for r in recordings])
    return min((white_sd(values, order, step) for order in ORDERS if values.size > order), default=1.0)


def noises(simulator: Simulator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Standard deviation of one sample of every compared channel [its unit], at least step / sqrt(12)."""
    out = {}
    for name, channel in simulator.channels.items():
        if channel.kind == "command":
            continue
        step = max(resolution(r[name]) for r in recordings)
        stated = channel.noise if np.isfinite(channel.noise) else estimate_noise(recordings, name, step)
        sd = max(stated, step / np.sqrt(12.0))
        out[name] = sd if sd > 0 else 1e-6 * max(1.0, float(np.nanstd(recordings[0][name])))
    return out


# Phases: named stretches of the logs, from a task, from contacts or from motion alone.


@dataclass(frozen=True)
class Phases:
    """`names` of phases; for each log when a phase begins (`starts` [s], ascending) and its `number`."""

    names: tuple[str, ...]
    starts: tuple[np.ndarray, ...]
    number: tuple[np.ndarray, ...]

    def of(self, rows: Rows) -> np.ndarray:
        """The phase (N,) of each row."""
        out = np.zeros(rows.log.size, int)
        for log in np.unique(rows.log):
            mine = rows.log == log
            at = np.searchsorted(self.starts[log], rows.time[mine], side="right") - 1
            out[mine] = self.number[log][np.maximum(at, 0)]
        return out


def phases_of(simulator: Simulator, recordings: Sequence[Recording], windows: Sequence[Window]) -> Phases:
    """Phases by contact where bodies touch in any window, else by motion."""
    if all(w.regime == FLIES for w in windows):
        return _phases_by_motion(simulator, recordings)
    by_log = [[w for w in windows if w.log == number] for number in range(len(recordings))]
    starts = [np.array([log.t[w.begin] for w in mine]) for log, mine in zip(recordings, by_log, strict=True)]
    number = [np.array([REGIMES.index(w.regime) for w in mine]) for mine in by_log]
    return Phases(REGIMES, tuple(starts), tuple(number))


def _phases_by_motion(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """`still` and `moving`: half seconds in which some position travels over a hundredth of its range."""
    reach = reaches(simulator, recordings)
    if not reach:
        none = [np.zeros(1, int) for _ in recordings]
        return Phases(("whole",), tuple(np.array([r.t[0]]) for r in recordings), tuple(none))
    starts, numbers = [], []
    for log in recordings:
        edges = np.arange(log.t[0], log.t[-1], min(0.5, 0.25 * float(log.t[-1] - log.t[0])))
        rows = np.searchsorted(log.t, edges)
        ends = np.append(rows[1:], len(log))
        moving = np.array([moves(log, int(a), int(b), reach) for a, b in zip(rows, ends, strict=True)], int)
        changes = np.flatnonzero(np.diff(moving, prepend=-1))
        starts.append(edges[changes])
        numbers.append(moving[changes])
    return Phases(("still", "moving"), tuple(starts), tuple(numbers))


def phases_by_task(recordings: Sequence[Recording], task: AnyTask, where: str = "task") -> Phases:
    """The phases of a task's `sequence`, found in each log by the HMM.

    Raises:
        InputError: The task is of blocks, the logs lack one of its channels, or a log does not follow it.
    """
    from hmmseg.io.task import SequenceTask
    from hmmseg.io.trial import Trial
    from hmmseg.sequence.segment import segment_sequence  # slow to import

    if not isinstance(task, SequenceTask):
        raise InputError(where, "is a task of blocks", 'sequence = ["approach", ...]')
    channels = task.channels or tuple(recordings[0].columns)
    for name in channels:
        if name not in recordings[0].columns:
            raise InputError(f"{where}: channels", f"no column {name}", ", ".join(recordings[0].columns))
    trials = [Trial(r.name, r.t, {n: r[n] for n in channels}) for r in recordings]
    starts, numbers = [], []
    for found in segment_sequence(trials, task):
        if found.failed is not None:
            raise InputError(found.file, f"does not follow {where}: {found.failed}")
        numbers.append(np.array([task.sequence.index(s.subtask) for s in found.spans]))
        starts.append(np.array([s.start for s in found.spans]))
    return Phases(task.sequence, tuple(starts), tuple(numbers))
