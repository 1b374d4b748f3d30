"""What is compared: the slow course in a subtask's own time, fast power in Hz, durations.

A subtask begins with an event, and what follows at once (an impact, a snap) takes its own time: the first
half second at most is compared second for second. The rest of the course follows the task's pace and is
compared at equal shares of what remains of the subtask; of both, means of equal parts. What fluctuates has
a clock of its own (a structure rings at its frequency however slowly the robot moves), so its spectrum is
taken in seconds from the subtask's start, over a window that every trial fills. All features of a trial
make one row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.integrate import cumulative_trapezoid

from simgap.generic.aligned import SPREAD, Cut, Ensembles

BINS = 16  # chosen: parts of a subtask whose means are compared, of which
EARLY = 6  # chosen: lie in the time after its event,
EVENT = 0.5  # chosen: s, or a quarter of the shortest
SUB_BANDS = 8  # chosen: of fast power, evenly spaced in log frequency
BANDS = 3  # look: into which they are gathered where cells are listed
LOWEST = 6  # chosen: half periods in the window that fast power starts from
FEWEST = 3  # chosen: coefficients of a sub-band; a window must give a band at least
FLOOR = 1e-4  # chosen: of a channel's scale: power below this is no different from none
SLOW, FAST, DURATION = range(3)


@dataclass(frozen=True)
class Layout:
    """What each of F features is: arrays (F,) of `channel` (-1: a duration), `subtask`, `kind`,
    `cell` and `width` (DCT coefficients of a power). A cell is what is listed: `cells[k]` = (channel,
    subtask, low, high) with its band in Hz.

    `event` (K,) [s]: how long a subtask is compared second for second (0 for the first, which begins with
    the recording); `window` (K,) [samples] of fast power; `coefficients[k]`: sub-bands as slices of its
    DCT; `bins` (K,): parts of the course; `scale` (C,) of channels; `rate` [Hz] common to all.
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
    cell: np.ndarray
    width: np.ndarray
    cells: tuple[tuple[int, int, float, float], ...]

    def where(self, kind: int, channel: int, subtask: int) -> np.ndarray:
        """Indices of the features of one kind in a channel and subtask."""
        return np.flatnonzero((self.kind == kind) & (self.channel == channel) & (self.subtask == subtask))


def layout(given: Ensembles) -> Layout:
    """Features that all trials have."""
    cuts = (*given.real, *given.sim)
    # Kinds recorded at different rates are compared at the lower one.
    rate = min(np.median([c.trial.rate for c in given.real]), np.median([c.trial.rate for c in given.sim]))
    durations = np.array([np.diff(c.edges) for c in cuts])
    shortest, bins, window, subs = durations.min(0), [], [], []
    values = [np.concatenate([c.trial.channels[n] for c in given.real]) for n in given.channels]
    other = [np.concatenate([c.trial.channels[n] for c in given.sim]) for n in given.channels]
    spread = np.array([np.subtract(*np.nanquantile(v, SPREAD[::-1])) for v in values])
    spread = np.maximum(spread, [np.subtract(*np.nanquantile(v, SPREAD[::-1])) for v in other])
    scale = np.where(spread > 0, spread, 1.0)
    rows, cells = [], []
    event = np.minimum(EVENT, shortest / 4)
    event[(np.arange(event.size) == 0) | (event * rate < 2 * EARLY)] = 0.0
    for k in range(len(given.subtasks)):
        bins.append(int(np.clip(shortest[k] * rate // 4, 1, BINS)))
        window.append(int(shortest[k] * rate))
        low = max(LOWEST, int(np.ceil(window[k] * bins[k] / (shortest[k] * rate))))
        subs.append(_sub_bands(low, window[k]))
        for c in range(len(given.channels)):
            top = bins[k] / (2 * float(np.median(durations[:, k])))
            rows += [(c, k, SLOW, len(cells), 1)] * bins[k]
            cells.append((c, k, 0.0, top))
            for group in np.array_split(np.arange(len(subs[k])), min(BANDS, max(len(subs[k]), 1))):
                if group.size:
                    widths = [s.stop - s.start for s in subs[k]]
                    rows += [(c, k, FAST, len(cells), widths[b]) for b in group.tolist()]
                    edges = subs[k][group[0]].start, subs[k][group[-1]].stop
                    cells.append((c, k, *(e * rate / (2 * window[k]) for e in edges)))
        rows.append((-1, k, DURATION, len(cells), 1))
        cells.append((-1, k, 0.0, 0.0))
    channel, subtask, kind, cell, width = np.array(rows).T
    return Layout(given, float(rate), scale, event, np.array(window), tuple(subs), np.array(bins),
                  channel, subtask, kind, cell, width, tuple(cells))  # fmt: skip


def bin_edges(given: Layout, start: float, end: float, subtask: int) -> np.ndarray:
    """Edges [s] of the parts of a subtask that lasts from start to end."""
    count, early = int(given.bins[subtask]), float(given.event[subtask])
    if not early or count < BINS:
        return np.linspace(start, end, count + 1)
    first = np.linspace(start, start + early, EARLY + 1)
    return np.concatenate([first, np.linspace(first[-1], end, count - EARLY + 1)[1:]])


def _sub_bands(low: int, window: int) -> tuple[slice, ...]:
    """Up to SUB_BANDS slices of DCT coefficients from `low`, none of fewer than FEWEST."""
    if window - low < FEWEST:
        return ()
    out, start = [], low
    for edge in np.geomspace(low, window, SUB_BANDS + 1)[1:]:
        stop = round(edge)
        if window - stop < FEWEST:  # what would be left is too narrow
            out.append(slice(start, window))
            break
        if stop - start >= FEWEST:
            out.append(slice(start, stop))
            start = stop
    return tuple(out)


def resampled(t: np.ndarray, values: np.ndarray, times: np.ndarray, rate: float) -> np.ndarray:
    """A signal with gaps at other times; averaged over 1 / rate where it was sampled much faster."""
    known = np.isfinite(values)
    if 1 / np.median(np.diff(t)) < 1.5 * rate:
        return np.interp(times, t[known], values[known])
    return means(t[known], values[known], times[:, None] + np.array([-0.5, 0.5]) / rate)[:, 0]


def means(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean values of a linearly interpolated signal between neighbouring edges (along the last axis)."""
    total = cumulative_trapezoid(values, t, initial=0.0)
    # Between samples the integral of a straight line is a parabola.
    k = np.clip(np.searchsorted(t, edges, side="right") - 1, 0, t.size - 2)
    w = edges - t[k]
    slope = (values[k + 1] - values[k]) / (t[k + 1] - t[k])
    integral = total[k] + w * (values[k] + 0.5 * w * slope)
    return np.diff(integral) / np.diff(edges)


def transformed(values: np.ndarray) -> np.ndarray:
    """DCT coefficients (..., n) of windows (..., n) without their straight lines.

    White noise of variance s² has s² in the square of every coefficient.
    """
    n = values.shape[-1]
    at = np.arange(n) - (n - 1) / 2
    slope = (values @ at) / max(at @ at, 1.0)
    return np.asarray(dct(values - values.mean(-1, keepdims=True) - slope[..., None] * at, norm="ortho"))


def windowed(
    given: Layout, cut: Cut, channel: int, subtask: int, delay: int = 0, values: np.ndarray | None = None
) -> np.ndarray:
    """Samples (window,) of a channel from a subtask's start less `delay` samples on.

    They never begin before the trial does.

    `values` stand for the channel's where given.
    """
    n, t = int(given.window[subtask]), cut.trial.t
    if values is None:
        values = cut.trial.channels[given.ensembles.channels[channel]]
    first = int(np.searchsorted(t, cut.edges[subtask] - 0.5 / given.rate))
    delay = min(delay, first)
    first -= delay
    inside = slice(first, first + n)
    times = cut.edges[subtask] + (np.arange(n) - delay + 0.5) / given.rate
    # Recorded samples as they are where they serve: between them noise would be smoothed.
    if 0 <= first <= t.size - n and np.isfinite(values[inside]).all():
        off = (t[inside] - t[first]) * given.rate - np.arange(n)
        if np.abs(off).max() < 0.75:
            return values[inside]
    return resampled(t, values, np.clip(times, t[0], t[-1]), given.rate)


def log_power(given: Layout, spectrum: np.ndarray, channel: int, subtask: int) -> np.ndarray:
    """Log mean power of the sub-bands (..., B) of spectra (..., window)."""
    parts = [spectrum[..., s].mean(-1) for s in given.coefficients[subtask]]
    floor = (FLOOR * given.scale[channel]) ** 2
    return np.log(np.stack(parts, -1) + floor) if parts else np.zeros((*spectrum.shape[:-1], 0))


def row(given: Layout, cut: Cut) -> np.ndarray:
    """All features (F,) of one trial: means in the channel's unit, log powers, log durations."""
    out = np.zeros(given.kind.size)
    for k in range(len(given.ensembles.subtasks)):
        edges = bin_edges(given, cut.edges[k], cut.edges[k + 1], k)
        out[(given.kind == DURATION) & (given.subtask == k)] = np.log(edges[-1] - edges[0])
        for c, name in enumerate(given.ensembles.channels):
            values = cut.trial.channels[name]
            known = np.isfinite(values)
            out[given.where(SLOW, c, k)] = means(cut.trial.t[known], values[known], edges)
            if given.coefficients[k]:
                out[given.where(FAST, c, k)] = log_power(
                    given, transformed(windowed(given, cut, c, k)) ** 2, c, k
                )
    return out


def rows(given: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Features of the real trials (R, F) and of the simulated ones (S, F)."""
    return (np.array([row(given, c) for c in given.ensembles.real]),
            np.array([row(given, c) for c in given.ensembles.sim]))  # fmt: skip
