"""What is known of a robot that did not change, from logs of it: how far a model of it is off, how surely.

See `simgap.robots.changes` for the model. A sample that jumps away from both neighbours and back is no
reading and left out. What is left of logs, run freely, is whitened: by a channel's process (a Kalman
filter), by what uncertain starts make of a log, and by the scatter of all parameters from motion to motion,
which logs of one motion share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm as normal
from scipy.stats import t as student

from hmmseg.errors import InputError
from hmmseg.online.compiled import compiled
from hmmseg.robust import robust_sd
from simgap.robots.calibrate import Calibration
from simgap.robots.fit import moved_to
from simgap.robots.linear import base_at, linearise, vary
from simgap.robots.model import Composed, Point
from simgap.robots.noise import resolution
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

BROKEN = 10.0  # chosen: of what 5 % of samples leave the mean of their neighbours by, a sample that is broken
SCATTER = 0.05  # prior: of a parameter's usual size, by which a model's error moves it from motion to motion
MOST = 0.2  # prior: likewise, at most; what is larger is for the processes
WEIGHT = 3.0  # prior: motions that this is worth
FEW = 3.0  # numerics: factor on the scatter that is learned from few motions, at most
ALIKE = 0.1  # chosen: of a command's usual size; logs whose commands are closer than this are of one motion
PASSES, ROUNDS = 3, 60  # numerics: of learning the processes, and of EM
POSITIVE = 0.05  # numerics: of its sd, above which a parameter that cannot be negative is varied by factors
STEP = 0.02  # numerics: of a finite difference


@dataclass(frozen=True)
class Broken:
    """A sample that no robot can have made: `value` of a channel of a log at `time` [s], left out."""

    log: str
    channel: str
    time: float
    value: float


def without_broken(
    simulator: Simulator, recordings: Sequence[Recording]
) -> tuple[list[Recording], list[Broken]]:
    """The recordings with samples left out that jump away from both neighbours and back at once."""
    out, found = [], []
    for log in recordings:
        columns = {}
        for name, channel in simulator.channels.items():
            if channel.kind == "command":
                continue
            values = log[name]
            seen = np.flatnonzero(np.isfinite(values))
            if seen.size < 5:
                continue
            v = values[seen]
            before, after = np.concatenate([[v[1]], v[:-1]]), np.concatenate([v[1:], [v[-2]]])
            off = v - (before + after) / 2
            out_of = (np.sign(v - before) == np.sign(v - after)) & (v != before) & (v != after)
            size = np.abs(off)
            usual = max(float(robust_sd(off)), float(np.quantile(size, 0.95)), resolution(values), 1e-300)
            beside = np.maximum(
                np.append(size[1:], 0.0), np.append(0.0, size[:-1])
            )  # a wild one has half of it
            wrong = seen[out_of & (size > BROKEN * usual) & (size > 1.5 * beside)]
            if wrong.size:
                columns[name] = np.where(np.isin(np.arange(values.size), wrong), np.nan, values)
                found += [Broken(log.name, name, float(log.t[k]), float(values[k])) for k in wrong]
        out.append(log.with_columns(columns) if columns else log)
    return out, found


@dataclass(frozen=True)
class Coordinates:
    """How parameters of effects are varied: `names` (effect, short), `at` (k,) their values at 0, `scale`
    (k,), `log` (k,) whether by factors, bounds."""

    names: tuple[tuple[str, str], ...]
    at: np.ndarray
    scale: np.ndarray
    log: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, composed: Composed, point: Point, effects: Sequence[str]) -> Coordinates:
        """Of all parameters of some effects about a point."""
        names = tuple((e, p) for e in effects for p in composed.effects[e].parameters)
        known = [composed.effects[e].parameters[p] for e, p in names]
        at = np.array([point.get(e, {}).get(p, q.nominal) for (e, p), q in zip(names, known, strict=True)])
        sd, low = np.array([q.sd for q in known]), np.array([q.low for q in known])
        log = (low >= 0) & (at > POSITIVE * np.minimum(sd, np.maximum(at, 1e-300) * 1e3)) & (at > 0)
        return cls(names, at, np.where(log, 1.0, sd), log, low, np.array([q.high for q in known]))

    def about(self, composed: Composed, point: Point) -> Coordinates:
        """The same parameters about another point."""
        return Coordinates.of(composed, point, [*dict.fromkeys(e for e, _ in self.names)])

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values (k,) at coordinates, within bounds."""
        moved = np.where(self.log, self.at * np.exp(np.clip(x, -7, 7)), self.at + self.scale * x)
        return np.clip(moved, self.low, self.high)

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivatives (k,) of values by coordinates."""
        return np.where(self.log, self.values(x), self.scale)

    def point(self, base: Point, x: np.ndarray) -> Point:
        """A point with these coordinates."""
        out = {e: dict(v) for e, v in base.items()}
        for (effect, short), value in zip(self.names, self.values(x), strict=True):
            out.setdefault(effect, {})[short] = float(value)
        return out


@dataclass(frozen=True)
class Process:
    """A channel's gap: standard deviation `sd` and correlation time `time` [s] of what drifts, `white`: the
    factor on the sensors' noise, `jitter` [s]: how far off the channel is in time, row by row."""

    sd: float
    time: float
    white: float
    jitter: float

    @classmethod
    def at(cls, z: np.ndarray, usual: float) -> Process:
        """From logarithms, of residuals of a usual size."""
        sd, time, white, jitter = np.exp(np.clip(z, -9, 5))
        return cls(float(usual * sd), float(time), float(max(white, 1.0)), float(jitter))


class Sequences:
    """The rows of every log's channels in order of time, side by side; `rates` (N,) of the channels."""

    def __init__(self, composed: Composed, rates: np.ndarray) -> None:
        rows = composed.rows
        key = rows.log * len(rows.channels) + rows.channel
        self.order = np.lexsort((rows.time, key))
        self.first = np.diff(key[self.order], prepend=-1) != 0
        self.channel, self.count = rows.channel[self.order], len(rows.channels)
        self.apart = np.where(self.first, 0.0, np.diff(rows.time[self.order], prepend=0.0))
        self.variance, self.rates = rows.variance[self.order], rates[self.order]

    def gains(self, processes: Sequence[Process], mine: slice | np.ndarray = slice(None)) -> Kalman:
        """Kalman's gains and the innovations' standard deviations, of all rows or some sequences."""
        sd, time, white, jitter = (
            np.array([getattr(p, n) for p in processes])[self.channel[mine] if len(processes) > 1 else 0]
            for n in ("sd", "time", "white", "jitter")
        )
        noise = self.variance[mine] * white**2 + (jitter * self.rates[mine]) ** 2
        decay = np.where(self.first[mine], 0.0, np.exp(-self.apart[mine] / time))
        return (*_gains(decay, noise, np.broadcast_to(sd**2, noise.shape)), decay)

    def filtered(self, kalman: Kalman, values: np.ndarray) -> np.ndarray:
        """Innovations in units of their standard deviations, of values (N,) or (N, c)."""
        out = np.empty((values.shape[0], values[0].size))
        out[self.order] = _innovations(*kalman, values.reshape(out.shape)[self.order])
        return out.reshape(values.shape)

    def learned(self, values: np.ndarray) -> list[Process]:
        """The process of every channel, from what a model leaves (N,), by maximum likelihood."""
        out, sorted_values = [], values[self.order]
        for c in range(self.count):
            mine = self.channel == c
            seen = sorted_values[mine, None]
            usual = float(np.sqrt(np.mean(seen**2))) + 1e-300

            def cost(z: np.ndarray, mine=mine, seen=seen, usual=usual) -> float:
                kalman = self.gains([Process.at(z, usual)], mine)
                return float(np.log(kalman[0]).sum() + 0.5 * np.sum(_innovations(*kalman, seen) ** 2))

            noise = float(np.sqrt(self.variance[mine].mean()))
            speed = float(np.sqrt(np.mean(self.rates[mine] ** 2))) + 1e-300
            start = np.log([1.0, 0.1, max(0.3 * usual / noise, 1.1), 0.3 * usual / speed])
            options = {"maxfev": 400, "xatol": 0.02, "fatol": 0.5}
            out.append(Process.at(minimize(cost, start, method="Nelder-Mead", options=options).x, usual))
        return out


Kalman = tuple[np.ndarray, np.ndarray, np.ndarray]  # spread, gain, decay from the row before, (N,) each


@compiled
def _gains(decay, noise, variance):
    spread, gain = np.empty_like(noise), np.empty_like(noise)
    left = 0.0
    for k in range(noise.size):
        ahead = decay[k] ** 2 * left + (1 - decay[k] ** 2) * variance[k]
        gain[k] = ahead / (ahead + noise[k])
        spread[k] = np.sqrt(ahead + noise[k])
        left = ahead - gain[k] * ahead
    return spread, gain


@compiled
def _innovations(spread, gain, decay, values):
    out, mean = np.empty_like(values), np.zeros(values.shape[1])
    for k in range(values.shape[0]):
        for c in range(values.shape[1]):
            ahead = decay[k] * mean[c]
            new = values[k, c] - ahead
            out[k, c] = new / spread[k]
            mean[c] = ahead + gain[k] * new
    return out


@dataclass(frozen=True)
class Null:
    """What is known of a robot that did not change: its `point`, the coordinates of what was fitted with
    their covariance (p, p), by channel the `processes`, all coordinates' scatter `tau` from log to log, and
    how well logs that took no part are met: logarithms of whitened mean squares (num_old,). `motions`: every
    log's."""

    point: Point
    theta: Coordinates
    covariance: np.ndarray
    processes: tuple[Process, ...]
    every: Coordinates
    tau: np.ndarray
    left: np.ndarray
    motions: list[Motion]

    def tail(self, left: np.ndarray) -> float:
        """The share of unchanged robots whose logs are met no better than those that leave squares `left`
        (num_logs,), by the mean of logarithms."""
        n, new = self.left.size, np.log(left)
        sd = max(float(self.left.std(ddof=1)), 0.1)
        far = float(new.mean() - self.left.mean()) / (sd * np.sqrt(1 / n + 1 / new.size))
        return float(student.sf(far, n - 1))


Motion = list[tuple[np.ndarray, np.ndarray, float]]  # by command times [s], values, and their usual size


def motions_of(composed: Composed) -> list[Motion]:
    """What every log's commands are."""
    logs, known = composed.recordings, composed.simulator.channels
    out: list[Motion] = [[] for _ in logs]
    for name in (n for n, c in known.items() if c.kind == "command"):
        every = np.concatenate([log[name] for log in logs])
        size = float(np.std(every) + abs(np.mean(every)))
        for mine, log in zip(out, logs, strict=True):
            mine.append((log.t - log.t[0], log[name], max(size, 1e-300)))
    return out


def of_one_motion(one: Motion, other: Motion) -> bool:
    """Whether commands are alike: logs of one motion share what a model gets wrong."""
    far = []
    for (t, a, size), (u, b, _) in zip(one, other, strict=True):
        both = t <= min(t[-1], u[-1])
        far.append(float(np.sqrt(np.mean((a[both] - np.interp(t[both], u, b)) ** 2))) / size)
    return bool(far) and max(far) < ALIKE


class Whitened:
    """Logs as whitened rows about a point: `composed` runs, `whiten` (see the module) and columns."""

    def __init__(self, composed: Composed, point: Point, every: Coordinates) -> None:
        self.composed, self.point, self.every = composed, point, every
        linear = linearise(composed, point, [])
        self.sequences, self.log = Sequences(composed, linear.rates), composed.rows.log
        self.linear, self.starts, self.residual = linear, linear.starts, linear.residual
        if not np.isfinite(self.residual).all():
            raise InputError("simulator", "does not follow a whole log", "a model that stays finite")
        window, doubts = composed.rows.window, []
        for state, column in self.starts.items():
            doubts.append(column * np.array([w.doubt.get(state, 0.0) for w in composed.windows])[window])
        own = [np.where(self.log == i, d, 0.0) for d in doubts for i in np.unique(self.log)]
        self.doubts = np.array(own).T.reshape(self.log.size, -1)
        self.columns = self.slopes(point, every)
        self.motions = motions_of(composed)
        first: list[Motion] = []
        number = np.zeros(len(self.motions), int)
        for log, motion in enumerate(self.motions):
            same = next((k for k, other in enumerate(first) if of_one_motion(motion, other)), len(first))
            first += [motion] if same == len(first) else []
            number[log] = same
        self.motion = number[self.log]  # (N,)

    def slopes(self, point: Point, of: Coordinates, x: np.ndarray | None = None) -> np.ndarray:
        """Derivatives (N, k) of the simulated rows by coordinates, at a point that holds them at x."""
        base, out = base_at(self.composed, point), np.zeros((self.log.size, len(of.names)))
        sizes = of.slopes(np.zeros(len(of.names)) if x is None else x)
        for effect in dict.fromkeys(e for e, _ in of.names):
            mine = np.array([e == effect for e, _ in of.names])
            sd = np.array([p.sd for p in self.composed.effects[effect].parameters.values()])
            one = vary(
                self.composed,
                base,
                self.starts,
                effect,
                step=STEP * np.maximum(sizes[mine], 1e-6 * sd) / sd,
                shifted=False,
            )
            if one is not None:
                out[:, mine] = np.nan_to_num(one.jacobian) * sizes[mine]
        return out

    def by(self, processes: Sequence[Process], tau: np.ndarray, scale: np.ndarray) -> None:
        """Learn how to whiten; `scale` (num_logs,): how much more of the processes each log has."""
        self.kalman, self.scale = self.sequences.gains(processes), scale
        self.parts = []
        loose = self.filtered(np.column_stack([self.columns * tau, self.doubts]))
        for number in np.unique(self.motion):
            rows = np.flatnonzero(self.motion == number)
            left, value, _ = np.linalg.svd(loose[rows], full_matrices=False)
            self.parts.append((rows, left, 1 - 1 / np.sqrt(1 + value**2)))

    def filtered(self, values: np.ndarray) -> np.ndarray:
        """Rows or columns in units of the processes, of each log's own size."""
        return self.sequences.filtered(self.kalman, (values.T / self.scale[self.log]).T)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Rows (N,) or columns (N, c) of independent unit noise."""
        out = self.filtered(values)
        for rows, left, less in self.parts:
            inner = (left.T @ out[rows]).T * less
            out[rows] -= left @ inner.T
        return out

    def rows(self, point: Point) -> np.ndarray:
        """Recorded less simulated (N,); NaN where a run diverged."""
        return self.composed.rows.observed - base_at(self.composed, point).rows


def learned(composed: Composed, calibration: Calibration | None, candidates: Sequence[str]) -> Null:
    """What OLD logs tell of a robot that does not change, about the point of its calibration."""
    point = {} if calibration is None else {n: dict(v) for n, v in calibration.point.items()}
    fitted = [e for e in point if not composed.numeric(e)]
    if fitted:  # once more, by what is learned about where a calibration by plain squares ends
        first = _learned(composed, point, fitted, candidates)
        whitened = Whitened(composed, point, first.every)
        whitened.by(first.processes, first.tau, np.exp(0.5 * first.left))
        point = moved_to(composed, whitened.linear, whitened.whiten, point, fitted).point
    return _learned(composed, point, fitted, candidates)


def _learned(composed: Composed, point: Point, fitted: Sequence[str], candidates: Sequence[str]) -> Null:
    """The same about a point."""
    theta = Coordinates.of(composed, point, fitted)
    every = Coordinates.of(composed, point, [*fitted, *(n for n in candidates if n not in fitted)])
    p, n = len(theta.names), len(composed.recordings)
    old = Whitened(composed, point, every)
    sd = np.array([composed.effects[e].parameters[s].sd for e, s in theta.names])
    prior = np.diag((theta.slopes(np.zeros(p)) / sd) ** 2) if p else np.zeros((0, 0))
    tau, left, scale = np.full(len(every.names), SCATTER), old.residual, np.ones(n)
    squares, level, processes = np.ones(n), 1.0, ()
    for _ in range(PASSES):
        processes = tuple(old.sequences.learned(left / scale[old.log]))
        old.by(processes, 0 * tau, scale)
        columns, white = old.filtered(old.columns), old.filtered(old.residual)
        told, pull = sums(columns, white, old.motion)
        for _ in range(ROUNDS):
            inside = np.linalg.inv(told + np.diag(tau**-2.0))
            less = told - told @ inside @ told
            drawn = pull - np.einsum("nij,njk,nk->ni", told, inside, pull)
            d = np.linalg.solve(less[:, :p, :p].sum(0) + prior, drawn[:, :p].sum(0))
            mean = np.einsum("nij,nj->ni", inside, pull - told[:, :, :p] @ d)
            square = mean**2 + np.diagonal(inside, axis1=1, axis2=2)
            tau = np.sqrt((square.sum(0) + WEIGHT * SCATTER**2) / (len(told) + WEIGHT - 2))
            tau = np.minimum(tau, MOST)
        left = old.residual - old.columns[:, :p] @ d - np.einsum("ij,ij->i", old.columns, mean[old.motion])
        old.by(processes, tau, scale)
        columns, white = old.whiten(old.columns[:, :p]), old.whiten(old.residual)
        told, pull = sums(columns, white, old.motion)
        apart = np.array([
            np.linalg.solve(told.sum(0) - told[i] + prior, pull.sum(0) - pull[i]) for i in range(len(told))
        ]).reshape(len(told), p)  # fmt: skip
        alone = white - np.einsum("ij,ij->i", columns, apart[old.motion])
        squares = np.bincount(old.log, alone**2) / np.bincount(old.log) * scale**2
        level = np.exp(np.mean(np.log(squares)))
        scale = np.sqrt(squares / level)
    size = level**0.5
    processes = tuple(
        Process(size * q.sd, q.time, max(size * q.white, 1.0), size * q.jitter) for q in processes
    )
    old.by(processes, tau, scale)
    columns = old.whiten(old.columns[:, :p])
    covariance = np.linalg.inv(columns.T @ columns + prior)
    few = float(student.ppf(0.975, max(len(told) - 1, 1)) / normal.ppf(0.975))  # of so few motions
    return Null(
        point, theta, covariance, processes, every, min(few, FEW) * tau, np.log(squares / level), old.motions
    )


def sums(columns: np.ndarray, white: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By group of rows the columns' products with each other and with the rows."""
    each = [group == i for i in range(group.max() + 1)]
    return (
        np.array([columns[m].T @ columns[m] for m in each]),
        np.array([columns[m].T @ white[m] for m in each]),
    )
