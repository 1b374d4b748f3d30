"""Whitening: a window's rows are correlated through its uncertain start and through what no one models.

With sensitivities D to the start, its variances P, and unmodelled accelerations a_c of each channel the rows
of a window have covariance

    N + D P D' + sum over channels s_c^2 L_c A L_c',   A[u, v] = exp(-|u - v| / TAU),

N the sensors' noise, L_c two integrals over time for a position, one for a velocity, none for a force or
where the simulator cannot be restarted: what is not modelled moves a joint even where the model has it
stuck. A body that moves on a support is another matter, for the support takes what pushes it: there L_c is
the model's own response to a change of the start's rate, come later. In flight and in contact a model is off
by other amounts: each regime has sizes of its own. Times of samples are uncertain by s of the source `clock`,
which adds s^2 times the squared rate. No impact is like another: which corner strikes first, where a surface
is rough. In the source `contacts` every effect may be off by s of its usual sizes, anew in each window in
which bodies move in contact, so that few impacts that a model misses decide nothing. Nor does a body come to
lie twice alike: by s of the sources `lying` it is elsewhere in each window of rest, and all that pushes it
there is in that. The s_c are found by maximum likelihood (type II) and are zero where that gains nothing. The
Cholesky factor turns rows into innovations: what each says beyond those before it in its window.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simgap.robots.blocks import NONE, Block, Discrepancy, Source
from simgap.robots.linear import Linear
from simgap.robots.model import Composed
from simgap.robots.tied import Tied
from simgap.robots.triangular import factored, solved_by
from simgap.robots.windows import FLIES, REGIMES, RESTS, STRIKES
from simgap.simulators.protocol import RATE

TAU = 0.1  # prior: s: unmodelled torques last for tenths of a second
ENOUGH = 40  # numerics: windows from which discrepancies are learned
BLOCK = 100  # numerics: samples of a channel that are whitened together, where no start ties channels


@dataclass(frozen=True)
class Whitener:
    """Lower Cholesky factors of blocks of rows."""

    blocks: tuple[np.ndarray, ...]
    factors: tuple[np.ndarray, ...]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Rows (N,) or columns (N, k), whitened; rows of diverged windows become 0."""
        out = np.zeros_like(values, float)
        for block, factor in zip(self.blocks, self.factors, strict=True):
            out[block] = solved_by(factor, values[block])
        return out

    @property
    def half_log_det(self) -> float:
        """Half the log determinant of all rows' covariance."""
        return sum(float(np.log(np.diag(factor)).sum()) for factor in self.factors)

    def half_log_dets(self, group: np.ndarray) -> np.ndarray:
        """The same by group of rows; `group` (N,), blocks are within groups."""
        own = [float(np.log(np.diag(factor)).sum()) for factor in self.factors]
        return np.bincount(group[[block[0] for block in self.blocks]], own, group.max() + 1)


@dataclass(frozen=True)
class Covariances:
    """Of all blocks of rows."""

    blocks: tuple[Block, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all sources."""
        return tuple(dict.fromkeys(n for b in self.blocks for n in b.sources))

    @cached_property
    def tied(self) -> Tied:
        """What discrepancies are learned from: blocks, evenly chosen, of as many rows as about ENOUGH large
        ones have."""
        rows = sum(b.rows.size for b in self.blocks) / max(len(self.blocks), 1)
        every = max(1, int(len(self.blocks) * rows / (ENOUGH * max(rows, BLOCK))))
        return Tied.of(self.blocks[::every], self.names)

    def whitener(self, discrepancy: Discrepancy = NONE) -> Whitener:
        """The whitener of all rows."""
        factors = [factored(block.covariance(discrepancy)) for block in self.blocks]
        return Whitener(tuple(block.rows for block in self.blocks), tuple(factors))


def covariances(composed: Composed, linear: Linear, factor: np.ndarray | None = None) -> Covariances:
    """Covariances of all windows that did not diverge; `factor` (N,) multiplies the noise's sd."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    blocks = []
    free = bool(linear.starts)
    for number, mine in enumerate(linear.rows.of):
        if mine.stop == mine.start or not np.isfinite(linear.residual[mine]).all():
            continue
        for rows in [np.arange(mine.start, mine.stop)] if free else _by_channel(linear, mine):
            scale = 1.0 if factor is None else factor[rows]
            moved = [linear.starts[n][rows] * doubt for n, doubt in composed.windows[number].doubt.items()]
            start = np.array(moved).reshape(-1, rows.size).T
            variance = linear.rows.variance[rows] * scale**2
            blocks.append(Block(rows, number, variance, start, _sources(linear, rows, kinds, free)))
    return Covariances(tuple(blocks))


def _by_channel(linear: Linear, window: slice) -> list[np.ndarray]:
    """Rows of stretches of each channel: without a start, nothing ties channels."""
    channel = linear.rows.channel[window]
    out = []
    for c in np.unique(channel):
        rows = window.start + np.flatnonzero(channel == c)
        out += np.array_split(rows, max(1, round(rows.size / BLOCK)))
    return out


CLOCK = "clock"  # a source whose s [s] is the sd of samples' times
LIES = "lying"  # a source whose s is the sd of where a body comes to rest, anew in each window, by channel
CONTACTS = "contacts"  # a source whose s is how many usual sizes every effect is off by in each contact
INTEGRALS = {"position": 2, "velocity": 1, "force": 0, "torque": 0}  # physics: of an acceleration


def _sources(linear: Linear, block: np.ndarray, kinds: Mapping[str, str], free: bool) -> dict[str, Source]:
    rows = linear.rows
    out: dict[str, Source] = {}
    since, channel, regime = rows.since[block], rows.channel[block], REGIMES[rows.regime[block[0]]]
    every = np.arange(since.size)
    for c in np.unique(channel):
        name, mine = rows.channels[c], channel == c
        t = since[mine]
        rate = linear.starts.get(f"{name}{RATE}")
        if regime == RESTS and name in linear.starts:
            out[f"{name}, {LIES}"] = Source(np.flatnonzero(mine), np.ones((t.size, t.size)))
            continue
        if rate is not None and regime == STRIKES:
            response = _propagated(t, since, channel, rate[block])
            moved = every if response.any() else every[:0]
            response = response[moved]
        else:
            moved, response = np.flatnonzero(mine), np.eye(t.size)
            for _ in range(INTEGRALS[kinds[name]] if free else 0):
                response = _integral(t) @ response
        key = name if regime == FLIES else f"{name}, {regime}"
        out[key] = Source(moved, response @ np.exp(-np.abs(t[:, None] - t) / TAU) @ response.T)
    if linear.wobble is not None and regime == STRIKES:
        out[CONTACTS] = Source(every, linear.wobble[block] @ linear.wobble[block].T)
    out[CLOCK] = Source(every, linear.rates[block] ** 2)
    return out


def _propagated(t: np.ndarray, since: np.ndarray, channel: np.ndarray, kick: np.ndarray) -> np.ndarray:
    """How rows (N,) respond to accelerations at times t (n,), (N, n): as they do to a change of the start's
    rate, `kick` (N,), that comes as much later."""
    step = np.gradient(t) if t.size > 1 else np.ones(1)
    out = np.zeros((since.size, t.size))
    for c in np.unique(channel):
        mine = channel == c
        late = since[mine][:, None] - t
        out[mine] = np.where(late > 0, np.interp(late, since[mine], kick[mine]), 0.0) * step
    return out


def _integral(t: np.ndarray) -> np.ndarray:
    """The matrix (n, n) that integrates over t from the window's start, by trapezia; before the first row
    a signal was as it is there."""
    step = np.diff(t, prepend=0.0)
    lower = np.tril(np.ones((t.size, t.size)))
    mean = 0.5 * (np.eye(t.size) + np.eye(t.size, k=-1))
    mean[0, 0] = 1.0
    return lower * step @ mean
