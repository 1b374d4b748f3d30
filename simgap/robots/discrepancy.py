"""How far the model is off by itself: discrepancies' sizes by maximum likelihood, multipliers by window."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import minimize

from simgap.robots.tied import Solved, Tied
from simgap.robots.whiten import BLOCK, NONE, Covariances, Discrepancy

# prior: sd of a window's log multiplier: the model is off by e (sd) from window to window
SPREAD = 1.0
GRID = tuple(range(-6, 17, 2))  # numerics: log multipliers
WORTH = 3.0  # chosen: nats that a discrepancy must gain to be there at all
FREEDOM = 4.0  # prior: of Student's t: heavy tails, finite variance
ENOUGH = 40  # learned: windows from which discrepancies are learned


def learned(cov: Covariances, residual: np.ndarray) -> Discrepancy:
    """The discrepancy of a residual (N,); channels for which it gains nothing have none."""
    names = tuple(dict.fromkeys(n for b in cov.blocks for n in b.sources))
    rows = sum(b.rows.size for b in cov.blocks) / max(len(cov.blocks), 1)
    every = max(1, int(len(cov.blocks) * rows / (ENOUGH * max(rows, BLOCK))))
    terms = [Tied.of(b, residual[b.rows], names) for b in cov.blocks[::every]]
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
    variance = np.square(list(scale.values()))
    for block in cov.blocks:
        own = cost.setdefault(block.window, 0.5 * (np.array(GRID) / SPREAD) ** 2)
        tied = Tied.of(block, residual[block.rows], tuple(scale))
        for i, g in enumerate(GRID):
            try:
                found = tied.solved(np.exp(g) * variance)
            except np.linalg.LinAlgError:  # so large that the noise is lost in rounding
                own[i] = np.inf
                continue
            own[i] += found.half + 0.5 * found.square
    return {number: float(np.exp(GRID[int(own.argmin())])) for number, own in cost.items()}


def _first_guess(terms: list[Tied], k: int) -> float:
    """Log variance that alone would explain the residual's excess."""
    ratio = [t.square / max(float(t.trace[k]), 1e-300) for t in terms if t.trace[k] > 0]
    return float(np.log(max(np.median(ratio), 1e-30))) if ratio else -60.0


def _value(x: np.ndarray, terms: list[Tied], kept: list[int]) -> float:
    """Minus log likelihood of the log variances; a window's rows together are Student's t, so that few in
    which the model is far off do not decide."""
    return sum(_student(term.solved(_variance(term, x, kept))) for term in terms)


def _variance(term: Tied, x: np.ndarray, kept: list[int]) -> np.ndarray:
    """Variances (K,) of all sources, 0 for those that are not kept."""
    out = np.zeros(term.trace.size)
    out[kept] = np.exp(x)
    return out


def _student(found: Solved) -> float:
    return found.half + 0.5 * (FREEDOM + found.tied.size) * float(np.log1p(found.square / FREEDOM))


def _cost(x: np.ndarray, terms: list[Tied], kept: list[int]) -> tuple[float, np.ndarray]:
    """`_value` and its gradient."""
    value, slope = 0.0, np.zeros(len(kept))
    for term in terms:
        variance = _variance(term, x, kept)
        found = term.solved(variance)
        value += _student(found)
        trace, pull = found.slopes()
        weight = (FREEDOM + term.size) / (FREEDOM + found.square)
        slope += 0.5 * (variance * (trace - weight * pull))[kept]
    return value, slope
