"""How far the model is off by itself: discrepancies' sizes by maximum likelihood, multipliers by window."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, lapack, solve_triangular
from scipy.optimize import minimize

from simgap.robots.whiten import BLOCK, NONE, Covariances, Discrepancy, Source, total

# prior: sd of a window's log multiplier: the model is off by e (sd) from window to window
SPREAD = 1.0
GRID = tuple(range(-6, 17, 2))  # numerics: log multipliers
WORTH = 3.0  # chosen: nats that a discrepancy must gain to be there at all
FREEDOM = 4.0  # prior: of Student's t: heavy tails, finite variance
ENOUGH = 40  # learned: windows from which discrepancies are learned

dpotri: Any = lapack.dpotri  # type: ignore[attr-defined]  # inverse from a Cholesky factor


def learned(cov: Covariances, residual: np.ndarray) -> Discrepancy:
    """The discrepancy of a residual (N,); channels for which it gains nothing have none."""
    names = tuple(dict.fromkeys(n for s in cov.sources for n in s))
    rows = sum(len(n) for n in cov.noise) / max(len(cov.blocks), 1)
    every = max(1, int(len(cov.blocks) * rows / (ENOUGH * max(rows, BLOCK))))
    terms = [
        _Terms(n, [s.get(name, Source(np.zeros(0, int), np.zeros((0, 0)))) for name in names], residual[b])
        for b, n, s in zip(cov.blocks[::every], cov.noise[::every], cov.sources[::every], strict=True)
    ]
    kept = list(range(len(names)))
    x = np.full(len(kept), -np.inf)
    for k in kept:
        guess = _first_guess(terms, k)
        trial = {
            v: _value(np.append(x[:k], v), terms, kept[: k + 1]) for v in guess - np.arange(0.0, 19.0, 3.0)
        }
        x[k] = min(trial, key=lambda v: trial[v])
    plain = _value(np.zeros(0), terms, [])
    while kept:
        bounds = [(v - 25.0, v + 12.0) for v in x]
        done = minimize(
            _cost, x, (terms, kept), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25}
        )
        if plain - done.fun < WORTH:
            return NONE
        costs = [
            _value(np.delete(done.x, i), terms, kept[:i] + kept[i + 1 :]) - done.fun for i in range(len(kept))
        ]
        least = int(np.argmin(costs))
        if costs[least] >= WORTH:
            scale = {names[k]: float(np.exp(v / 2)) for k, v in zip(kept, done.x, strict=True)}
            return Discrepancy(scale, _multipliers(cov, residual, scale))
        kept, x = kept[:least] + kept[least + 1 :], np.delete(done.x, least)
    return NONE


def _multipliers(cov: Covariances, residual: np.ndarray, scale: Mapping[str, float]) -> dict[int, float]:
    """Each window's multiplier, the mode on a grid.

    Their spread is not learned: a multiplier is found from the residual that it then discounts, so with a
    spread to match, windows in which a cause shows most would count least and the fit would follow those in
    which nothing happens.
    """
    cost: dict[int, np.ndarray] = {}
    for block, number, noise, sources in zip(cov.blocks, cov.window, cov.noise, cov.sources, strict=True):
        own = cost.setdefault(number, 0.5 * (np.array(GRID) / SPREAD) ** 2)
        for i, g in enumerate(GRID):
            try:
                factor = cholesky(total(noise, sources, scale, np.exp(g)), lower=True, check_finite=False)
            except LinAlgError:  # so large that the noise is lost in rounding
                own[i] = np.inf
                continue
            white = solve_triangular(factor, residual[block], lower=True, check_finite=False)
            own[i] += float(np.log(np.diag(factor)).sum() + 0.5 * white @ white)
    return {number: float(np.exp(GRID[int(own.argmin())])) for number, own in cost.items()}


@dataclass(frozen=True)
class _Terms:
    """Of one block: covariance of noise, of every source, and the residual."""

    noise: np.ndarray
    sources: list[Source]
    residual: np.ndarray


def _first_guess(terms: list[_Terms], k: int) -> float:
    """Log variance that alone would explain the residual's excess."""
    ratio = [
        float(t.residual @ t.residual) / max(float(np.trace(t.sources[k].covariance)), 1e-300)
        for t in terms
        if np.trace(t.sources[k].covariance) > 0
    ]
    return float(np.log(max(np.median(ratio), 1e-30))) if ratio else -60.0


def _value(x: np.ndarray, terms: list[_Terms], kept: list[int]) -> float:
    """Minus log likelihood of the log variances; a window's rows together are Student's t, so that few in
    which the model is far off do not decide."""
    variance = np.exp(x)
    return sum(_one(term, variance, kept)[0] for term in terms)


def _one(term: _Terms, variance: np.ndarray, kept: list[int]) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Of one block: minus log likelihood, Cholesky factor, its solution of the residual, and the square."""
    whole = term.noise.copy()
    for v, k in zip(variance, kept, strict=True):
        term.sources[k].add(whole, v)
    factor = cholesky(whole, lower=True, check_finite=False)
    alpha = cho_solve((factor, True), term.residual, check_finite=False)
    n, square = len(whole), float(term.residual @ alpha)
    value = float(np.log(np.diag(factor)).sum()) + 0.5 * (FREEDOM + n) * np.log1p(square / FREEDOM)
    return value, factor, alpha, square


def _cost(x: np.ndarray, terms: list[_Terms], kept: list[int]) -> tuple[float, np.ndarray]:
    """`_value` and its gradient."""
    value, slope, variance = 0.0, np.zeros(len(kept)), np.exp(x)
    for term in terms:
        own, factor, alpha, square = _one(term, variance, kept)
        value += own
        weight = (FREEDOM + len(alpha)) / (FREEDOM + square)
        inverse = np.tril(dpotri(factor, lower=1)[0])
        inverse += np.tril(inverse, -1).T
        for i, (v, k) in enumerate(zip(variance, kept, strict=True)):
            source = term.sources[k]
            pull = alpha[source.rows] @ source.covariance @ alpha[source.rows]
            trace = float(np.sum(source.within(inverse) * source.covariance))
            slope[i] += 0.5 * v * (trace - weight * float(pull))
    return value, slope
