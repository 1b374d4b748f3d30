"""Residuals and sensitivities of all windows, whitened: recorded less simulated, and how effects move it.

The start of a window is uncertain; with sensitivities D to the start and its variances P the residual of
a window has covariance N + D P D', N the sensors' noise. Its Cholesky factor turns rows into
innovations in the order of time: what each sample says beyond those before it in its window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from hmmseg.errors import InputError
from simgap.robots.model import Composed, Point
from simgap.robots.windows import Window
from simgap.simulators.protocol import Channels, run_all

RATE_LIMIT = 100.0  # Hz: residuals are means over neighbours down to this rate
STEP = 0.05  # of a parameter's standard deviation: the finite difference
START_STEP = 0.3  # of a start's


@dataclass(frozen=True)
class Linear:
    """The gap about a point: n whitened rows, by log, channel, window and time.

    `residual` (n,) at the point; `jacobian` effect -> (n, k) derivative of the prediction by its
    parameters; `raw` (n,) the residual in the channel's unit, not whitened; `diverged` are effects whose
    rollouts were not finite.
    """

    residual: np.ndarray
    raw: np.ndarray
    log: np.ndarray
    channel: np.ndarray
    window: np.ndarray
    time: np.ndarray
    channels: tuple[str, ...]
    jacobian: dict[str, np.ndarray]
    diverged: tuple[str, ...]
    dropped: int  # windows whose nominal rollout was not finite


def linearise(composed: Composed, point: Point, effects: Sequence[str]) -> Linear:
    """Residuals at a point, and derivatives by the parameters of these effects, by forward differences.

    InputError where the simulator diverges in every window.
    """
    begun = composed.starts(point)
    true = run_all(composed.simulator, composed.jobs(point, begun))
    read = composed.read(true, point)
    if all(channels is None for channels in read):
        raise InputError("simulator", "gives values that are not finite in every window", "finite channels")
    starts = _by_start(composed, point, begun, read)
    columns: dict[str, list[list[Channels | None]]] = {}
    diverged = []
    for name in effects:
        columns[name] = _by_effect(composed, point, name, true, read, begun, starts)
        if any(
            r is not None and c is None for column in columns[name] for r, c in zip(read, column, strict=True)
        ):
            diverged.append(name)
            del columns[name]
    names = tuple(n for n, c in composed.simulator.channels.items() if c.kind != "command")
    parts = []
    for k, window in enumerate(composed.windows):
        here = read[k]
        if here is not None:
            moved = {name: [column[k] for column in of] for name, of in columns.items()}
            parts.append(_rows(composed, k, window, names, here, starts[k], moved))
    kept = [p for p in parts if p[0].size]
    if not kept:
        raise InputError("recordings", "have no samples of the channels to compare", "numbers")
    joined = [np.concatenate([p[i] for p in kept]) for i in range(6)]
    jacobian = {name: np.concatenate([p[6][name] for p in kept]) for name in columns}
    dropped = sum(channels is None for channels in read)
    residual, raw, log, channel, number, time = joined
    return Linear(residual, raw, log, channel, number, time, names, jacobian, tuple(diverged), dropped)


def step_of(composed: Composed, effect: str, name: str, value: float) -> float:
    """A finite difference that stays within bounds."""
    parameter = composed.effects[effect].parameters[name]
    step = STEP * parameter.sd
    return step if value + step <= parameter.high else -step


def _difference(a: Channels | None, b: Channels | None, step: float) -> Channels | None:
    return None if a is None or b is None else {n: (b[n] - a[n]) / step for n in a}


def _by_start(composed: Composed, point: Point, begun, read) -> list[dict[str, tuple[float, Channels]]]:
    """By window: state -> its standard deviation, and the derivative of the channels as read by it."""
    states = list(dict.fromkeys(n for w in composed.windows for n in w.doubt))
    by_window: list[dict[str, tuple[float, Channels]]] = [{} for _ in composed.windows]
    for state in states:
        steps = [START_STEP * w.doubt.get(state, 0.0) for w in composed.windows]
        moved = [
            s if s is None or state not in s else {**s, state: s[state] + h}
            for s, h in zip(begun, steps, strict=True)
        ]
        there = composed.read(run_all(composed.simulator, composed.jobs(point, moved)), point)
        for k, (h, a, b) in enumerate(zip(steps, read, there, strict=True)):
            change = None if h == 0 else _difference(a, b, h)
            if change is not None:
                by_window[k][state] = (composed.windows[k].doubt[state], change)
    return by_window


def _by_effect(composed: Composed, point: Point, name: str, true, read, begun, starts):
    """For each parameter of an effect, by window, the derivative of the channels as read."""
    effect = composed.effects[name]
    values = {**effect.neutral(), **point.get(name, {})}
    out: list[list[Channels | None]] = []
    for short in effect.parameters:
        step = step_of(composed, name, short, values[short])
        moved = {**point, name: {**values, short: values[short] + step}}
        if effect.read is None:
            run = run_all(composed.simulator, composed.jobs(moved, begun))
            out.append(
                [_difference(a, b, step) for a, b in zip(read, composed.read(run, moved), strict=True)]
            )
            continue
        changes = [_difference(a, b, step) for a, b in zip(read, composed.read(true, moved), strict=True)]
        restarted = composed.starts(moved)
        out.append([
            _restarted(change, old, new, by_state, step)
            for change, old, new, by_state in zip(changes, begun, restarted, starts, strict=True)
        ])  # fmt: skip
    return out


def _restarted(change: Channels | None, old, new, by_state, step: float) -> Channels | None:
    """A read-out's derivative with that of the start, which is read through it too."""
    if change is None or old is None:
        return change
    out = dict(change)
    for state, (_, derivative) in by_state.items():
        for channel in out:
            out[channel] = out[channel] + derivative[channel] * ((new[state] - old[state]) / step)
    return out


def _rows(composed: Composed, number: int, window: Window, names, here: Channels, starts, moved):
    """Whitened rows of one window: residual, raw, log, channel, window, time, Jacobians."""
    log = composed.recordings[window.log].window(window.begin, window.end)
    span = log.t[-1] - log.t[0]
    group = max(1, round(len(log) / max(span * RATE_LIMIT, 1.0)))
    groups = [np.arange(i, min(i + group, len(log))) for i in range(0, len(log), group)]

    def picked(channels: Channels) -> np.ndarray:
        return np.array([np.mean(channels[n][rows[seen]]) for rows, n, seen in cells])

    cells = []
    for rows in groups:
        for name in names:
            seen = np.isfinite(log[name][rows])
            if seen.any():
                cells.append((rows, name, seen))
    size = len(cells)
    if size == 0:
        return (*tuple(np.empty(0) for _ in range(6)), {})
    raw = picked(log.columns) - picked(here)
    variance = np.array([composed.noise[n] ** 2 / seen.sum() for _, n, seen in cells])
    covariance = np.diag(variance)
    for doubt, change in starts.values():
        column = picked(change) * doubt
        covariance += np.outer(column, column)
    factor = np.linalg.cholesky(covariance)
    jacobian = {
        effect: solve_triangular(factor, np.stack([picked(c) for c in of], 1), lower=True)
        for effect, of in moved.items()
    }
    channel = np.array([names.index(n) for _, n, _ in cells])
    time = np.array([log.t[rows[seen]].mean() for rows, _, seen in cells])
    return (
        solve_triangular(factor, raw, lower=True), raw, np.full(size, window.log), channel,
        np.full(size, number), time, jacobian,
    )  # fmt: skip
