"""Whitening: a window's rows are correlated through its uncertain start and through what no effect explains.

With sensitivities D to the start, its variances P, and unmodelled accelerations a_c of each channel the rows
of a window have covariance

    N + D P D' + sum over channels s_c^2 L_c A L_c',   A[u, v] = exp(-|u - v| / TAU),

with N the sensors' noise and L_c two integrals over time for a position, one for a velocity, none for a force
or where the simulator does not restart: an unmodelled torque moves a joint even where the model has it stuck.
A body that moves on a support is another matter, for the support takes what pushes it: there L_c is the
model's own response to a later change of the start's rate. Each regime (flight, contact) has sizes of its
own.

There are further sources of discrepancy. `clock`: times of samples are uncertain by s, which adds s^2 times
the squared rate. `contacts`: no impact is like another (which corner strikes first, where a surface is
rough), so every effect may be off by s of its usual sizes, anew in each window of contact, and a few missed
impacts decide nothing. `lying`: a body does not come to rest twice alike, so it is s elsewhere in each window
of rest.

The s are maximum-likelihood estimates (type II), and zero where that gains nothing. The inverse Cholesky
factor turns rows into innovations: what each says beyond those before it in its window.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from simgap.robots.linear import Linear
from simgap.robots.model import Composed
from simgap.robots.windows import DOUBT, FLIES, REGIMES, RESTS, STRIKES
from simgap.simulators.protocol import RATE

dpotrf: Any = lapack.dpotrf
dpotri: Any = lapack.dpotri
dtrtrs: Any = lapack.dtrtrs
dtrtri: Any = lapack.dtrtri

TAU = 0.1  # prior: s: how long unmodelled torques last
ENOUGH = 40  # numerics: windows from which discrepancies are learned
BLOCK = 100  # numerics: samples of a channel that are whitened together where there is no start
SMOOTH = 12  # numerics: smooth directions of a channel in a block
ALONE = -4.0  # prior: log odds that a window is off for reasons of its own
# numerics: log variances below a first guess; one source may end in another's place, so the better of two
# starts is taken
BELOW = (0.0, 8.0)
WORTH = 3.0  # chosen: nats that a source must gain to count at all
NOTHING = 0.01  # numerics: nats to which log variances are found
CLOSE = {"maxiter": 40, "ftol": 1e-6, "gtol": 0.05}  # numerics: of their search


Discrepancy = dict[str, float]  # s by source, of a channel [unit / s^2, unit / s or unit]
NONE = Discrepancy()


@dataclass(frozen=True)
class Source:
    """A discrepancy at s = 1 among some `rows` (k,) of a block: a `factor` F (k, r) of its covariance F F',
    or standard deviations (k,) where it correlates none."""

    rows: np.ndarray
    factor: np.ndarray

    def over(self, sd: np.ndarray) -> Source:
        """The same in units of the block's rows' noise, `sd` (n,)."""
        mine = sd[self.rows]
        return Source(self.rows, self.factor / (mine if self.factor.ndim == 1 else mine[:, None]))

    def along(self, directions: np.ndarray, diagonal: bool = False) -> np.ndarray:
        """Its covariance (m, m) along the columns of `directions` (n, m), or the variances (m,) alone."""
        mine = directions[self.rows]
        seen = self.factor[:, None] * mine if self.factor.ndim == 1 else self.factor.T @ mine
        return np.sum(seen**2, 0) if diagonal else seen.T @ seen


def _covariance(
    variance: np.ndarray, start: np.ndarray, sources: Iterable[tuple[Source, float]]
) -> np.ndarray:
    """The covariance (n, n) of noise, a start and sources, each with its s."""
    every, out = [start], np.diag(variance)
    for source, s in sources:
        if source.factor.ndim == 1:
            out[source.rows, source.rows] += (s * source.factor) ** 2
        elif source.rows.size == variance.size:
            every.append(s * source.factor)
        else:
            out[source.rows[:, None], source.rows] += (s**2 * source.factor) @ source.factor.T
    both = np.concatenate(every, 1)
    return out + both @ both.T


@dataclass(frozen=True)
class Block:
    """Correlated rows of one window.

    `rows`: their numbers (n,); `window`: the window; `variance`: of sensor noise (n,); `start`: change (n, S)
    by one standard deviation of each state of the start; `sources`: discrepancies by name; `channel`: the
    rows' channels (n,); `repeats`: the number of logs that repeat the same motion.
    """

    rows: np.ndarray
    window: int
    variance: np.ndarray
    start: np.ndarray
    sources: Mapping[str, Source]
    channel: np.ndarray
    repeats: int = 1

    def covariance(self, discrepancy: Discrepancy = NONE) -> np.ndarray:
        """The rows' covariance (n, n) with a discrepancy."""
        mine = [(self.sources[n], s) for n, s in discrepancy.items() if n in self.sources]
        return _covariance(self.variance, self.start, mine)


@dataclass(frozen=True, eq=False)
class Whitener:
    """Inverse lower Cholesky factors of blocks of rows, and half the log determinant of each block's
    covariance."""

    blocks: tuple[np.ndarray, ...]
    inverses: tuple[np.ndarray, ...]
    half_logs: tuple[float, ...]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Whiten rows (N,) or columns (N, k); rows of diverged windows become 0."""
        out = np.zeros_like(values, float)
        for block, inverse in zip(self.blocks, self.inverses, strict=True):
            out[block] = inverse @ values[block]
        return out

    @property
    def half_log_det(self) -> float:
        """Half the log determinant of all rows' covariance."""
        return sum(self.half_logs)

    def half_log_dets(self, group: np.ndarray) -> np.ndarray:
        """The same by group of rows; `group` (N,), blocks are within groups."""
        return np.bincount(group[[block[0] for block in self.blocks]], self.half_logs, group.max() + 1)


@dataclass(frozen=True, eq=False)
class Covariances:
    """Of all blocks of rows."""

    blocks: tuple[Block, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all sources."""
        return tuple(dict.fromkeys(n for b in self.blocks for n in b.sources))

    def floor(self) -> float:
        """The expected squares of whitened rows under noise alone, from which starts are read too."""
        total = 0.0
        for block in self.blocks:
            factor = _factored(block.covariance())
            sure = np.column_stack([np.diag(np.sqrt(block.variance)), block.start / DOUBT])
            total += float(np.sum(solved_by(factor, sure) ** 2))
        return total

    def estimate(
        self,
        residual: np.ndarray,
        wide: Mapping[int, float] | None = None,
        known: Discrepancy | None = None,
    ) -> Discrepancy:
        """The discrepancy of a residual, by maximum likelihood; none of sources that gain less than WORTH.

        Args:
            residual: The residual (N,).
            wide: Windows with a larger variance, and its factor.
            known: The discrepancy without these windows: the search begins there, and among its sources.
        """
        smooth, names = _smooth(self), self.names
        left, rest = smooth.projected(residual, wide or {})
        x = smooth.first_guess(left)
        if known is not None:
            smooth, names = smooth.among([names.index(n) for n in known]), tuple(known)
            x = 2 * np.log(np.array([*known.values()]))
        plain = smooth.value(np.full(len(names), -np.inf), left, rest)
        while names:
            bounds = [(v - 20.0, v + 12.0) for v in x]
            given: dict[str, Any] = {"args": (left, rest), "jac": True, "bounds": bounds, "options": CLOSE}
            begun = [x - below for below in BELOW[: 2 if len(names) == len(self.names) else 1]]
            ended = [minimize(smooth.cost, one, method="L-BFGS-B", **given) for one in begun]
            done = min(ended, key=lambda one: one.fun)
            each = np.where(np.eye(len(names), dtype=bool), -np.inf, done.x)
            without = [smooth.value(one, left, rest) - done.fun for one in each]
            if plain - done.fun >= WORTH and min(without) >= WORTH:
                return {n: float(np.exp(v / 2)) for n, v in zip(names, done.x, strict=True)}
            # What is next to nothing goes at once, else the source that is needed least.
            kept = np.flatnonzero(np.array(without) > max(min(without), NOTHING))
            smooth, names, x = smooth.among(kept), tuple(names[k] for k in kept), done.x[kept]
        return NONE

    def whitener(
        self, discrepancy: Discrepancy | None = None, wide: Mapping[int, float] | None = None
    ) -> Whitener:
        """The whitener of all rows with a discrepancy; `wide`: windows with a larger variance, and its
        factor."""
        made = [_whitened(block, discrepancy or NONE) for block in self.blocks]
        factor = [1.0 if wide is None else wide.get(block.window, 1.0) for block in self.blocks]
        return Whitener(
            tuple(block.rows for block in self.blocks),
            tuple(dtrtri(one, lower=1)[0] / f**0.5 for (one, _), f in zip(made, factor, strict=True)),
            tuple(
                h + 0.5 * b.rows.size * np.log(f)
                for (_, h), b, f in zip(made, self.blocks, factor, strict=True)
            ),
        )

    def starts(self, whiten: Whitener, residual: np.ndarray) -> dict[int, np.ndarray]:
        """Where a residual (N,) puts the start of every window, in standard deviations (S,) from it."""
        white = whiten(residual)
        return {
            b.window: (inverse @ b.start).T @ white[b.rows]
            for b, inverse in zip(self.blocks, whiten.inverses, strict=True)
        }

    def without_starts(self, whiten: Whitener, residual: np.ndarray) -> np.ndarray:
        """A residual (N,) less what the uncertain starts of windows make of it."""
        out, white = residual.copy(), whiten(np.nan_to_num(residual))
        for b, inverse in zip(self.blocks, whiten.inverses, strict=True):
            out[b.rows] -= b.start @ ((inverse @ b.start).T @ white[b.rows])
        return out

    def outliers(self, whiten: Whitener, residual: np.ndarray) -> dict[int, float]:
        """Windows whose residual (N,) exceeds noise and discrepancy, with the factor of their variance.

        A start misread where a joint came to rest moves all that follows, and no model is to explain it. One
        window in a few dozen is expected to be such.
        """
        square, count = dict[int, float](), dict[int, int]()
        white = whiten(residual) ** 2
        for block in self.blocks:
            square[block.window] = square.get(block.window, 0.0) + float(white[block.rows].sum())
            count[block.window] = count.get(block.window, 0) + block.rows.size
        found = {}
        for window, n in count.items():
            factor = square[window] / n
            if factor > 1 and 0.5 * (square[window] - n - n * np.log(factor)) > -ALONE:
                found[window] = factor
        return found


def _whitened(block: Block, discrepancy: Discrepancy) -> tuple[np.ndarray, float]:
    """A block's Cholesky factor and half log determinant.

    Of G repeats with one discrepancy d of covariance K in common, the sum of what each tells with N + G K is
    what all tell together of anything that they have in common: (N / G + K)^-1 = G (N + G K)^-1. Their mean
    has the log determinant of N + G K, their differences that of N.
    """
    again = block.repeats if discrepancy else 1
    shared = {n: s * again**0.5 for n, s in discrepancy.items()}
    factor = _factored(block.covariance(shared))
    half = float(np.log(np.diag(factor)).sum())
    if again == 1:
        return factor, half
    apart = float(np.log(np.diag(_factored(block.covariance()))).sum())
    return factor, half / again + (1 - 1 / again) * apart


@dataclass(frozen=True)
class _Smooth:
    """The likelihood of the discrepancies, cheaply: blocks in the directions in which starts and
    discrepancies move them most, in units of the rows' noise and padded to one size.

    In all other directions rows count as independent, each with the `share` (N,) that is left of it, with
    variance 1 and that of each source at s = 1, `white` (K, N): what correlates no rows is as large there. By
    the smooth directions alone what is smooth could be called white, at the expense of all rows.

    `basis` by block (n, m); covariances without discrepancy, `plain` (B, m, m), and of each source at s = 1,
    `source` (K, B, m, m).
    """

    rows: tuple[np.ndarray, ...]
    windows: tuple[int, ...]
    scale: tuple[np.ndarray, ...]
    basis: tuple[np.ndarray, ...]
    plain: np.ndarray
    source: np.ndarray
    share: np.ndarray
    white: np.ndarray

    @classmethod
    def of(cls, blocks: tuple[Block, ...], names: tuple[str, ...]) -> _Smooth:
        """Of these blocks and sources."""
        scale, basis, parts = [], [], []
        for block in blocks:
            sd = np.sqrt(block.variance)
            start = block.start / sd[:, None]
            each = [block.sources[n].over(sd) if n in block.sources else None for n in names]
            smooth = [one for one in each if one is not None and one.factor.ndim == 2 and one.rows.size > 1]
            sizes = [max(float(np.sum(f**2)), 1e-300) ** -0.5 for f in (start, *(o.factor for o in smooth))]
            both = _covariance(np.zeros(sd.size), sizes[0] * start, zip(smooth, sizes[1:], strict=True))
            count = min(sd.size, SMOOTH * np.unique(block.channel).size)
            b = np.linalg.eigh(both)[1][:, -count:]
            other = np.eye(sd.size) - b @ b.T
            scale.append(sd)
            basis.append(b)
            whole = [np.eye(count) + (b.T @ start) @ (b.T @ start).T]
            whole += [np.zeros((count, count)) if one is None else one.along(b) for one in each]
            rest = [np.zeros(sd.size) if one is None else one.along(other, diagonal=True) for one in each]
            parts.append((whole, rest))
        size = max((b.shape[1] for b in basis), default=0)
        plain = np.tile(np.eye(size), (len(blocks), 1, 1))
        source = np.zeros((len(names), len(blocks), size, size))
        for i, (whole, _) in enumerate(parts):
            m = len(whole[0])
            plain[i, :m, :m] = whole[0]
            source[:, i, :m, :m] = np.array(whole[1:]).reshape(-1, m, m)
        share = np.maximum(np.concatenate([1 - np.sum(b**2, 1) for b in basis] or [np.zeros(0)]), 1e-9)
        rest = [np.array(one).reshape(len(names), -1) for _, one in parts]
        white = np.maximum(np.concatenate(rest or [np.zeros((len(names), 0))], 1), 0.0) / share
        rows, windows = tuple(b.rows for b in blocks), tuple(b.window for b in blocks)
        return cls(rows, windows, tuple(scale), tuple(basis), plain, source, share, white)

    def projected(self, residual: np.ndarray, wide: Mapping[int, float]) -> tuple[np.ndarray, np.ndarray]:
        """A residual (N,) along the blocks' directions (B, m) and what is left of it (N,), in units of the
        noise, `wide` windows narrowed."""
        out, rest = np.zeros(self.plain.shape[:2]), []
        for i, (rows, sd, b) in enumerate(zip(self.rows, self.scale, self.basis, strict=True)):
            mine = residual[rows] / sd / wide.get(self.windows[i], 1.0) ** 0.5
            out[i, : b.shape[1]] = b.T @ mine
            rest.append(mine - b @ out[i, : b.shape[1]])
        return out, np.concatenate(rest or [np.zeros(0)])

    def first_guess(self, left: np.ndarray) -> np.ndarray:
        """Log variances (K,) with which all sources together make up the squares."""
        trace = np.einsum("kbii->kb", self.source)
        squares = np.sum(left**2, 1)
        out = []
        for mine in trace:
            there = mine > 0
            share = np.median(squares[there] / mine[there]) if there.any() else 1e-26
            out.append(np.log(max(float(share), 1e-30) / max(len(trace), 1)))
        return np.array(out)

    def among(self, kept: Sequence[int] | np.ndarray) -> _Smooth:
        """The same with some of the sources, by number."""
        return replace(self, source=self.source[kept], white=self.white[kept])

    def value(self, x: np.ndarray, left: np.ndarray, rest: np.ndarray) -> float:
        """Minus the log likelihood at log variances (K,) of the sources."""
        variance = np.exp(x)
        factors = [_factored(one) for one in self.plain + np.tensordot(variance, self.source, 1)]
        square = sum(float(np.sum(solved_by(f, y) ** 2)) for f, y in zip(factors, left, strict=True))
        own = 1 + variance @ self.white
        half = sum(float(np.log(np.diag(f)).sum()) for f in factors) + 0.5 * float(self.share @ np.log(own))
        return half + 0.5 * square + 0.5 * float(np.sum(rest**2 / own))

    def cost(self, x: np.ndarray, left: np.ndarray, rest: np.ndarray) -> tuple[float, np.ndarray]:
        """`value`, and its gradient (K,)."""
        variance = np.exp(x)
        whole = self.plain + np.tensordot(variance, self.source, 1)
        inverse, half_logs = _inverted(whole)
        pull = np.einsum("bij,bj->bi", inverse, left)
        value = half_logs + 0.5 * float(np.sum(pull * left))
        slope = np.tensordot(self.source, inverse - pull[:, :, None] * pull[:, None], 3)
        own = 1 + variance @ self.white
        value += 0.5 * float(self.share @ np.log(own) + np.sum(rest**2 / own))
        slope = slope + self.white @ (self.share / own - (rest / own) ** 2)
        return value, 0.5 * variance * slope


@lru_cache(maxsize=1)  # of the latest alone, as a search keeps the covariances of all its sets
def _smooth(of: Covariances) -> _Smooth:
    rows = sum(b.rows.size for b in of.blocks) / max(len(of.blocks), 1)
    every = max(1, int(len(of.blocks) * rows / (ENOUGH * max(rows, BLOCK))))
    return _Smooth.of(of.blocks[::every], of.names)


def _inverted(matrices: np.ndarray) -> tuple[np.ndarray, float]:
    """Inverses (B, m, m) of covariances (B, m, m), and the sum of half their log determinants."""
    upper, half = np.empty_like(matrices), 0.0
    for one, out in zip(matrices, upper, strict=True):
        factor = _factored(one)
        half += float(np.log(np.diag(factor)).sum())
        out[:] = dpotri(factor, lower=1, overwrite_c=1)[0].T
    return upper + np.triu(upper, 1).transpose(0, 2, 1), half


def _factored(matrix: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor, by LAPACK itself: checks would take most time with many small matrices."""
    factor, fault = dpotrf(matrix, lower=1, clean=1)
    if fault:
        raise np.linalg.LinAlgError("not positive definite")
    return factor


def solved_by(factor: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """L^-1 columns (n, k) with a lower factor L (n, n)."""
    if not columns.size:
        return np.zeros(columns.shape)
    out, fault = dtrtrs(factor, columns, lower=1)
    if fault:
        raise np.linalg.LinAlgError("singular")
    return out


def covariances(composed: Composed, linear: Linear) -> Covariances:
    """Covariances of all windows that did not diverge."""
    kinds = {n: c.kind for n, c in composed.simulator.channels.items()}
    blocks = []
    free, repeats = bool(linear.starts), composed.repeats()
    for number, mine in enumerate(linear.rows.of):
        if mine.stop == mine.start or not np.isfinite(linear.residual[mine]).all():
            continue
        for rows in [np.arange(mine.start, mine.stop)] if free else _by_channel(linear, mine):
            moved = [linear.starts[n][rows] * doubt for n, doubt in composed.windows[number].doubt.items()]
            start = np.array(moved).reshape(-1, rows.size).T
            variance = linear.rows.variance[rows]
            sources = _sources(composed, linear, rows, kinds)
            blocks.append(
                Block(rows, number, variance, start, sources, linear.rows.channel[rows], repeats[number])
            )
    return Covariances(tuple(blocks))


def _by_channel(linear: Linear, window: slice) -> list[np.ndarray]:
    """Stretches of each channel's rows, as nothing correlates channels without a start."""
    channel = linear.rows.channel[window]
    out = []
    for c in np.unique(channel):
        rows = window.start + np.flatnonzero(channel == c)
        out += np.array_split(rows, max(1, round(rows.size / BLOCK)))
    return out


CLOCK = "clock"  # s: standard deviation of the samples' times [s]
LIES = "lying"  # s: standard deviation of where a body comes to rest, by channel
CONTACTS = "contacts"  # s: usual sizes by which every effect is off in each contact
INTEGRALS = {"position": 2, "velocity": 1, "force": 0, "torque": 0}  # physics: of an acceleration over time


def _sources(
    composed: Composed, linear: Linear, block: np.ndarray, kinds: Mapping[str, str]
) -> dict[str, Source]:
    rows, wobble = linear.rows, composed.wobble
    out: dict[str, Source] = {}
    since, channel, regime = rows.since[block], rows.channel[block], REGIMES[rows.regime[block[0]]]
    every = np.arange(since.size)
    for c in np.unique(channel):
        name, mine = rows.channels[c], channel == c
        t = since[mine]
        rate = linear.starts.get(f"{name}{RATE}")
        if regime == RESTS and name in linear.starts:
            out[f"{name}, {LIES}"] = Source(np.flatnonzero(mine), np.ones((t.size, 1)))
            continue
        key = name if regime == FLIES else f"{name}, {regime}"
        if rate is not None and regime == STRIKES:
            response = _propagated(t, since, channel, rate[block])
            moved = every if response.any() else every[:0]
            out[key] = Source(moved, response[moved] @ _integrated(t.tobytes(), 0))
        else:
            times = INTEGRALS[kinds[name]] if linear.starts else 0
            out[key] = Source(np.flatnonzero(mine), _integrated(t.tobytes(), times))
    if wobble is not None and regime == STRIKES:
        out[CONTACTS] = Source(every, wobble[block[0] : block[-1] + 1])
    out[CLOCK] = Source(every, linear.rates[block])
    return out


def _propagated(t: np.ndarray, since: np.ndarray, channel: np.ndarray, kick: np.ndarray) -> np.ndarray:
    """Response (N, n) of rows to accelerations at times t (n,): as to a change of the start's rate, `kick`
    (N,), that comes later."""
    step = np.gradient(t) if t.size > 1 else np.ones(1)
    out = np.zeros((since.size, t.size))
    for c in np.unique(channel):
        mine = channel == c
        late = since[mine][:, None] - t
        out[mine] = np.where(late > 0, np.interp(late, since[mine], kick[mine]), 0.0) * step
    return out


@lru_cache(maxsize=512)
def _integrated(since: bytes, times: int) -> np.ndarray:
    """A factor (n, n) of the covariance of unmodelled accelerations, each what is left of the one before and
    something new, integrated `times` times; cached, as most windows are alike."""
    t = np.frombuffer(since)
    new = np.sqrt(-np.expm1(-2 * np.diff(t, prepend=-np.inf) / TAU))
    out = np.tril(np.exp(-np.abs(t[:, None] - t) / TAU)) * new
    for _ in range(times):
        out = _integral(t) @ out
    return out


def _integral(t: np.ndarray) -> np.ndarray:
    """The matrix (n, n) that integrates over t from the window's start, by trapezia; before its first row a
    signal is constant."""
    step = np.diff(t, prepend=0.0)
    lower = np.tril(np.ones((t.size, t.size)))
    mean = 0.5 * (np.eye(t.size) + np.eye(t.size, k=-1))
    mean[0, 0] = 1.0
    return lower * step @ mean
