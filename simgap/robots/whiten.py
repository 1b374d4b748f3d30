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
    """Lower Cholesky factors of blocks of rows; by block half the log determinant of their covariance, and
    the mean square of a row, whitened: less than 1 where repeats tell one thing together."""

    blocks: tuple[np.ndarray, ...]
    factors: tuple[np.ndarray, ...]
    half_logs: tuple[float, ...]
    told: tuple[float, ...]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Rows (N,) or columns (N, k), whitened; rows of diverged windows become 0."""
        out = np.zeros_like(values, float)
        for block, factor in zip(self.blocks, self.factors, strict=True):
            out[block] = solved_by(factor, values[block])
        return out

    @property
    def half_log_det(self) -> float:
        """Half the log determinant of all rows' covariance."""
        return sum(self.half_logs)

    def half_log_dets(self, group: np.ndarray) -> np.ndarray:
        """The same by group of rows; `group` (N,), blocks are within groups."""
        return np.bincount(group[[block[0] for block in self.blocks]], self.half_logs, group.max() + 1)

    def counted(self, rows: int) -> np.ndarray:
        """By how much each of so many rows counts (N,)."""
        out = np.ones(rows)
        for block, told in zip(self.blocks, self.told, strict=True):
            out[block] = told
        return out


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
        made = [_whitened(block, discrepancy) for block in self.blocks]
        return Whitener(
            tuple(block.rows for block in self.blocks),
            tuple(factor for factor, _, _ in made),
            tuple(half for _, half, _ in made),
            tuple(told for _, _, told in made),
        )


def _whitened(block: Block, discrepancy: Discrepancy) -> tuple[np.ndarray, float, float]:
    """A block's factor, half log determinant, and the mean square of its whitened rows.

    Of G repeats with one discrepancy d of covariance K between them, what they tell together of anything that
    they have in common is what each tells by N + G K, added up: (N / G + K)^-1 = G (N + G K)^-1. The mean has
    the log determinant of N + G K, what differs between them that of N.
    """
    again = block.repeats if discrepancy else 1
    shared = Discrepancy({n: s * again**0.5 for n, s in discrepancy.scale.items()})
    factor = factored(block.covariance(shared))
    half = float(np.log(np.diag(factor)).sum())
    if again == 1:
        return factor, half, 1.0
    plain = block.covariance()
    apart = factored(plain)
    own = float(np.sum(solved_by(factor, apart) ** 2)) / len(plain)
    share = 1 / again
    return factor, share * half + (1 - share) * float(np.log(np.diag(apart)).sum()), share + (1 - share) * own


def covariances(composed: Composed, linear: Linear, factor: np.ndarray | None = None) -> Covariances:
    """Covariances of all windows that did not diverge; `factor` (N,) multiplies the noise's sd."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    blocks = []
    free, repeats = bool(linear.starts), composed.repeats()
    for number, mine in enumerate(linear.rows.of):
        if mine.stop == mine.start or not np.isfinite(linear.residual[mine]).all():
            continue
        for rows in [np.arange(mine.start, mine.stop)] if free else _by_channel(linear, mine):
            scale = 1.0 if factor is None else factor[rows]
            moved = [linear.starts[n][rows] * doubt for n, doubt in composed.windows[number].doubt.items()]
            start = np.array(moved).reshape(-1, rows.size).T
            variance = linear.rows.variance[rows] * scale**2
            sources = _sources(linear, rows, kinds, free)
            blocks.append(Block(rows, number, variance, start, sources, repeats[number]))
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
