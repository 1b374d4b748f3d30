"""The rows that windows give: means over neighbouring samples of every compared channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.robust import white_sd
from simgap.robots.windows import REGIMES, Window
from simgap.simulators.protocol import Channels, Simulator
from simgap.simulators.recording import Recording

FOLDS = 6  # numerics: parts that are held out in turn; each fit keeps five sixths
RATE_LIMIT = 100.0  # chosen: Hz: residuals are means over neighbours down to this rate


@dataclass(frozen=True)
class Rows:
    """N rows by window, in each by time and then channel: `log`, `channel`, `window` numbers, `time` [s].

    `observed` (N,) in the channel's unit and `variance` (N,) of its sensor noise; `of` are each window's
    rows; `_picks` says which samples make up which row.
    """

    channels: tuple[str, ...]
    log: np.ndarray
    channel: np.ndarray
    window: np.ndarray
    time: np.ndarray
    since: np.ndarray  # s from the window's first sample
    regime: np.ndarray  # the number of its window's in REGIMES
    observed: np.ndarray
    variance: np.ndarray
    of: tuple[slice, ...]
    _picks: tuple[_Pick, ...]

    def averaged(self, read: Sequence[Channels | None]) -> np.ndarray:
        """Rows (N,) of simulated channels by window; NaN where a rollout diverged."""
        out = np.full(self.log.size, np.nan)
        for pick, mine, channels in zip(self._picks, self.of, read, strict=True):
            if channels is not None and mine.stop > mine.start:
                out[mine] = pick.mean(np.array([channels[name] for name in self.channels]))
        return out

    def rms(self, left: np.ndarray, among: np.ndarray | None = None) -> dict[str, float]:
        """Root mean square by channel of values (N,), `among` some rows (N,) where a channel has any."""
        out = {}
        for c, name in enumerate(self.channels):
            mine = (self.channel == c) & (True if among is None else among)
            if mine.any():
                out[name] = float(np.sqrt(np.mean(left[mine] ** 2)))
        return out


@dataclass(frozen=True)
class _Pick:
    """Groups of samples: first sample of each, which are `seen` (C, n), and how many of each (C, groups)."""

    first: np.ndarray
    seen: np.ndarray
    count: np.ndarray

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Means over groups (rows,) of values (C, n)."""
        total = np.add.reduceat(np.where(self.seen, values, 0.0), self.first, axis=1)
        return (total / np.maximum(self.count, 1)).T[(self.count > 0).T]


def rows_of(recordings: Sequence[Recording], windows: Sequence[Window], noise: Mapping[str, float]) -> Rows:
    """Rows of all windows. InputError where there is no sample at all."""
    names, sd = tuple(noise), np.array([*noise.values()])
    picks, parts, of, at = [], [], [], 0
    for number, window in enumerate(windows):
        log = recordings[window.log].window(window.begin, window.end)
        span = max(float(log.t[-1] - log.t[0]), 1e-9)
        size = max(1, round(len(log) / max(span * RATE_LIMIT, 1.0)))
        first, values = np.arange(0, len(log), size), np.array([log[n] for n in names])
        seen = np.isfinite(values)
        pick = _Pick(first, seen, np.add.reduceat(seen.astype(int), first, axis=1))
        stamps = np.add.reduceat(log.t, first) / np.diff(np.append(first, len(log)))
        group, channel = np.nonzero(pick.count.T)
        variance, n = sd[channel] ** 2 / pick.count[channel, group], group.size
        of_window = np.full(n, window.log), channel, np.full(n, number), stamps[group]
        parts.append((*of_window, stamps[group] - log.t[0], pick.mean(values), variance))
        picks.append(pick)
        of.append(slice(at, at + n))
        at += n
    if at == 0:
        raise InputError("recordings", "have no samples of the channels to compare", "numbers")
    log, channel, window, time, since, observed, variance = map(np.concatenate, zip(*parts, strict=True))
    regime = np.array([REGIMES.index(w.regime) for w in windows])[window]
    return Rows(names, log, channel, window, time, since, regime, observed, variance, tuple(of), tuple(picks))


def folds_of(rows: Rows, num_logs: int, groups: Sequence[int] | None = None) -> np.ndarray:
    """The fold (N,) of each row: logs, dealt out in turn; windows of one or two logs in stretches. With
    `groups` (num_logs,), logs of one number are held out together."""
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


# The noise of each channel: as stated or learned from differences, at least its resolution's.


ORDERS = (2, 4)  # numerics: of differences: the second is less noisy, the fourth blinder to motion


def resolution(values: np.ndarray) -> float:
    """The step that all values are whole multiples of apart, 0 where there is none."""
    distinct = np.unique(np.round(values[np.isfinite(values)], 9))
    if distinct.size < 3:
        return 0.0
    gaps = np.diff(distinct)
    step = float(gaps.min())
    multiples = gaps / step
    off = np.abs(multiples - np.round(multiples))
    return step if np.quantile(off, 0.95) < 0.05 else 0.0


def learned(recordings: Sequence[Recording], name: str) -> float:
    """Standard deviation of white noise from differences, robustly, the least of those of ORDERS: motion only
    adds to them. A second difference holds gravity, a fourth no parabola."""
    values = np.concatenate([r[name][np.isfinite(r[name])] for r in recordings])
    return min((white_sd(values, order) for order in ORDERS if values.size > order), default=1.0)


def noises(simulator: Simulator, recordings: Sequence[Recording]) -> dict[str, float]:
    """Standard deviation of one sample of every compared channel [its unit], at least step / sqrt(12)."""
    out = {}
    for name, channel in simulator.channels.items():
        if channel.kind == "command":
            continue
        step = max(resolution(r[name]) for r in recordings)
        stated = channel.noise if np.isfinite(channel.noise) else learned(recordings, name)
        found = max(stated, step / np.sqrt(12.0))
        out[name] = found if found > 0 else 1e-6 * max(1.0, float(np.nanstd(recordings[0][name])))
    return out
