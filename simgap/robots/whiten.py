"""Whitening: a window's rows are correlated through its uncertain start and through what no one models.

With sensitivities D to the start, its variances P, and unmodelled accelerations a_c of each channel the rows
of a window have covariance

    N + D P D' + m sum over channels s_c^2 L_c A L_c',   A[u, v] = exp(-|u - v| / TAU),

N the sensors' noise, L_c two integrals over time for a position, one for a velocity, none for a force or
where the simulator cannot be restarted: what is not modelled moves a joint even where the model has it
stuck. Times of samples are uncertain by s of the source `clock`, which adds s^2 times the squared rate.
The s_c are found by maximum likelihood (type II) and are zero where that gains nothing; the multiplier m of
each window (log-normal: the model is off in some places more than in others) by its posterior mode. The
Cholesky factor turns rows into innovations: what each says beyond those before it in its window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from simgap.robots.linear import Linear
from simgap.robots.windows import Window

TAU = 0.1  # chosen: s: unmodelled torques last for tenths of a second
# chosen: sd of a window's log multiplier: the model is off by e (sd) from window to window
SPREAD = 1.0
GRID = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)  # numerics
WORTH = 3.0  # chosen: nats that a discrepancy must gain to be there at all
FREEDOM = 4.0  # chosen: of Student's t: heavy tails, finite variance
ENOUGH = 40  # learned: windows from which discrepancies are learned
BLOCK = 400  # chosen: rows of a window that are whitened together, where no start ties them


@dataclass(frozen=True)
class Discrepancy:
    """`scale`: s by channel [unit / s^2, unit / s or unit]; `multiplier` m by window, 1 by default."""

    scale: Mapping[str, float]
    multiplier: Mapping[int, float]

    def __bool__(self) -> bool:
        return bool(self.scale)


NONE = Discrepancy({}, {})


@dataclass(frozen=True)
class Whitener:
    """Lower Cholesky factors of blocks of rows."""

    blocks: tuple[slice, ...]
    factors: tuple[np.ndarray, ...]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Rows (N,) or columns (N, k), whitened; rows of diverged windows become 0."""
        out = np.zeros_like(values, float)
        for block, factor in zip(self.blocks, self.factors, strict=True):
            out[block] = solve_triangular(factor, values[block], lower=True, check_finite=False)
        return out


@dataclass(frozen=True)
class Covariances:
    """Of every block of rows: its window, the covariance of noise and start, and of each channel's
    discrepancy at s = 1 where it has any rows."""

    blocks: tuple[slice, ...]
    window: tuple[int, ...]
    noise: tuple[np.ndarray, ...]
    sources: tuple[dict[str, np.ndarray], ...]

    def whitener(self, discrepancy: Discrepancy = NONE) -> Whitener:
        """The whitener of all rows."""
        factors = [
            cholesky(_total(n, s, discrepancy.scale, discrepancy.multiplier.get(w, 1.0)), lower=True)
            for n, s, w in zip(self.noise, self.sources, self.window, strict=True)
        ]
        return Whitener(self.blocks, tuple(factors))


def _total(
    noise: np.ndarray, sources: Mapping[str, np.ndarray], scale: Mapping[str, float], multiplier: float
) -> np.ndarray:
    out = noise.copy()
    for name, s in scale.items():
        if name in sources:
            out += multiplier * s**2 * sources[name]
    return out


def covariances(
    linear: Linear, windows: Sequence[Window], kinds: Mapping[str, str], factor: np.ndarray | None = None
) -> Covariances:
    """Covariances of all windows that did not diverge. `kinds` by channel; `factor` (N,) multiplies the
    noise's sd."""
    blocks, numbers, noises, sources = [], [], [], []
    free = bool(linear.starts)
    for number, mine in enumerate(linear.rows.of):
        if mine.stop == mine.start or not np.isfinite(linear.residual[mine]).all():
            continue
        step = mine.stop - mine.start if free else BLOCK
        for a in range(mine.start, mine.stop, step):
            block = slice(a, min(a + step, mine.stop))
            scale = 1.0 if factor is None else factor[block]
            noise = np.diag(linear.rows.variance[block] * scale**2)
            for state, doubt in windows[number].doubt.items():
                column = linear.starts[state][block] * doubt
                noise += np.outer(column, column)
            blocks.append(block)
            numbers.append(number)
            noises.append(noise)
            sources.append(_sources(linear, block, kinds, free))
    return Covariances(tuple(blocks), tuple(numbers), tuple(noises), tuple(sources))


CLOCK = "clock"  # a source whose s [s] is the sd of samples' times
INTEGRALS = {"position": 2, "velocity": 1, "force": 0, "torque": 0}  # chosen


def _sources(linear: Linear, block: slice, kinds: Mapping[str, str], free: bool) -> dict[str, np.ndarray]:
    rows, out = linear.rows, {}
    since, channel = rows.since[block], rows.channel[block]
    for c in np.unique(channel):
        name, mine = rows.channels[c], channel == c
        t = since[mine]
        response = np.eye(t.size)
        for _ in range(INTEGRALS[kinds[name]] if free else 0):
            response = _integral(t) @ response
        own = response @ np.exp(-np.abs(t[:, None] - t) / TAU) @ response.T
        whole = np.zeros((since.size, since.size))
        whole[np.ix_(mine, mine)] = own
        out[name] = whole
    out[CLOCK] = np.diag(linear.rates[block] ** 2)
    return out


def _integral(t: np.ndarray) -> np.ndarray:
    """The matrix (n, n) that integrates over t from the window's start, by trapezia; before the first row
    a signal was as it is there."""
    step = np.diff(t, prepend=0.0)
    lower = np.tril(np.ones((t.size, t.size)))
    mean = 0.5 * (np.eye(t.size) + np.eye(t.size, k=-1))
    mean[0, 0] = 1.0
    return lower * step @ mean


def learned(cov: Covariances, residual: np.ndarray) -> Discrepancy:
    """The discrepancy of a residual (N,); channels for which it gains nothing have none."""
    names = tuple(dict.fromkeys(n for s in cov.sources for n in s))
    every = max(1, len(cov.blocks) // ENOUGH)
    terms = [
        _Terms(n, [s.get(name, np.zeros_like(n)) for name in names], residual[b])
        for b, n, s in zip(cov.blocks[::every], cov.noise[::every], cov.sources[::every], strict=True)
    ]
    kept = list(range(len(names)))
    x = np.full(len(kept), -np.inf)
    for k in kept:
        guess = _first_guess(terms, k)
        trial = {
            v: _cost(np.append(x[:k], v), terms, kept[: k + 1])[0] for v in guess - np.arange(0.0, 19.0, 3.0)
        }
        x[k] = min(trial, key=lambda v: trial[v])
    plain = _cost(np.zeros(0), terms, [])[0]
    while kept:
        bounds = [(v - 25.0, v + 12.0) for v in x]
        done = minimize(
            _cost, x, (terms, kept), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25}
        )
        if plain - done.fun < WORTH:
            return NONE
        costs = [
            _cost(np.delete(done.x, i), terms, kept[:i] + kept[i + 1 :])[0] - done.fun
            for i in range(len(kept))
        ]
        least = int(np.argmin(costs))
        if costs[least] >= WORTH:
            scale = {names[k]: float(np.exp(v / 2)) for k, v in zip(kept, done.x, strict=True)}
            return Discrepancy(scale, _multipliers(cov, residual, scale))
        kept, x = kept[:least] + kept[least + 1 :], np.delete(done.x, least)
    return NONE


def _multipliers(cov: Covariances, residual: np.ndarray, scale: Mapping[str, float]) -> dict[int, float]:
    """Each window's multiplier, the mode on a grid."""
    out: dict[int, list] = {}
    for block, number, noise, sources in zip(cov.blocks, cov.window, cov.noise, cov.sources, strict=True):
        costs = out.setdefault(number, [0.5 * (g / SPREAD) ** 2 for g in GRID])
        for i, g in enumerate(GRID):
            factor = cholesky(_total(noise, sources, scale, np.exp(g)), lower=True, check_finite=False)
            white = solve_triangular(factor, residual[block], lower=True, check_finite=False)
            costs[i] += float(np.log(np.diag(factor)).sum() + 0.5 * white @ white)
    return {number: float(np.exp(GRID[int(np.argmin(costs))])) for number, costs in out.items()}


@dataclass(frozen=True)
class _Terms:
    """Of one block: covariance of noise, of every source, and the residual."""

    noise: np.ndarray
    sources: list[np.ndarray]
    residual: np.ndarray


def _first_guess(terms: list[_Terms], k: int) -> float:
    """Log variance that alone would explain the residual's excess."""
    ratio = [
        float(t.residual @ t.residual) / max(float(np.trace(t.sources[k])), 1e-300)
        for t in terms
        if np.trace(t.sources[k]) > 0
    ]
    return float(np.log(max(np.median(ratio), 1e-30))) if ratio else -60.0


def _cost(x: np.ndarray, terms: list[_Terms], kept: list[int]) -> tuple[float, np.ndarray]:
    """Minus log likelihood of the log variances, and its gradient; a window's rows together are Student's t,
    so that few in which the model is far off do not decide."""
    value, slope, variance = 0.0, np.zeros(len(kept)), np.exp(x)
    for term in terms:
        total = term.noise.copy()
        for v, k in zip(variance, kept, strict=True):
            total += v * term.sources[k]
        factor = cholesky(total, lower=True, check_finite=False)
        alpha = cho_solve((factor, True), term.residual, check_finite=False)
        n, square = len(total), float(term.residual @ alpha)
        value += float(np.log(np.diag(factor)).sum()) + 0.5 * (FREEDOM + n) * np.log1p(square / FREEDOM)
        weight = (FREEDOM + n) / (FREEDOM + square)
        if kept:
            inverse = cho_solve((factor, True), np.eye(len(total)), check_finite=False)
            for i, (v, k) in enumerate(zip(variance, kept, strict=True)):
                own = term.sources[k]
                slope[i] += 0.5 * v * (float(np.sum(inverse * own)) - weight * float(alpha @ own @ alpha))
    return value, slope
