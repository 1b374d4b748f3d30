"""How far the model is off by itself: discrepancies' sizes by maximum likelihood.

One size for all windows of a regime. A size of each window's own, or heavy tails, would be found from the
residual that it then discounts: windows that happen to be met would decide by the sensors' noise, those in
which a cause shows would count for little, and where a search ends would hang on where it began.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from simgap.progress import say
from simgap.robots.tied import Solved, Tied
from simgap.robots.whiten import BLOCK, NONE, Covariances, Discrepancy

WORTH = 3.0  # chosen: nats that a discrepancy must gain to be there at all
# numerics: log variances are found to a hundredth of a nat
CLOSE = {"maxiter": 25, "ftol": 1e-6, "gtol": 0.05}
ENOUGH = 40  # learned: windows from which discrepancies are learned


def learned(cov: Covariances, residual: np.ndarray, near: Discrepancy | None = None) -> Discrepancy:
    """The discrepancy of a residual (N,); channels for which it gains nothing have none. `near`: that of a
    residual of which this one is a part, with which to begin; what that has none of, this has none of."""
    names = tuple(dict.fromkeys(n for b in cov.blocks for n in b.sources))
    if near is not None:
        names = tuple(n for n in names if n in near.scale)
    rows = sum(b.rows.size for b in cov.blocks) / max(len(cov.blocks), 1)
    every = max(1, int(len(cov.blocks) * rows / (ENOUGH * max(rows, BLOCK))))
    terms = [Tied.of(b, residual[b.rows], names) for b in cov.blocks[::every]]
    kept = list(range(len(names)))
    x = np.full(len(kept), -np.inf)
    if near is not None:
        x = np.array([2 * np.log(near.scale[n]) for n in names])
    for k in kept if near is None else ():
        guess = _first_guess(terms, k)
        trial = {
            v: _value(np.append(x[:k], v), terms, kept[: k + 1]) for v in guess - np.arange(0.0, 19.0, 3.0)
        }
        x[k] = min(trial, key=lambda v: trial[v])
    plain = _value(np.zeros(0), terms, [])
    while kept:
        bounds = [(v - 25.0, v + 12.0) for v in x]
        done = minimize(_cost, x, (terms, kept), jac=True, method="L-BFGS-B", bounds=bounds, options=CLOSE)
        if plain - done.fun < WORTH:
            return NONE
        costs = [
            _value(np.delete(done.x, i), terms, kept[:i] + kept[i + 1 :]) - done.fun for i in range(len(kept))
        ]
        least = int(np.argmin(costs))
        if costs[least] >= WORTH:
            scale = {names[k]: float(np.exp(v / 2)) for k, v in zip(kept, done.x, strict=True)}
            return Discrepancy(scale)
        kept, x = kept[:least] + kept[least + 1 :], np.delete(done.x, least)
    return NONE


def _first_guess(terms: list[Tied], k: int) -> float:
    """Log variance that alone would explain the residual's excess."""
    ratio = [t.square / max(float(t.trace[k]), 1e-300) for t in terms if t.trace[k] > 0]
    return float(np.log(max(np.median(ratio), 1e-30))) if ratio else -60.0


def _value(x: np.ndarray, terms: list[Tied], kept: list[int]) -> float:
    """Minus log likelihood of the log variances."""
    return sum(_cost_of(term.solved(_variance(term, x, kept))) for term in terms)


def _variance(term: Tied, x: np.ndarray, kept: list[int]) -> np.ndarray:
    """Variances (K,) of all sources, 0 for those that are not kept."""
    out = np.zeros(term.trace.size)
    out[kept] = np.exp(x)
    return out


def _cost_of(found: Solved) -> float:
    return found.half + 0.5 * found.square


def _cost(x: np.ndarray, terms: list[Tied], kept: list[int]) -> tuple[float, np.ndarray]:
    """`_value` and its gradient."""
    say("how far the model is off by itself")
    value, slope = 0.0, np.zeros(len(kept))
    for term in terms:
        variance = _variance(term, x, kept)
        found = term.solved(variance)
        value += _cost_of(found)
        trace, pull = found.slopes()
        slope += 0.5 * (variance * (trace - pull))[kept]
    return value, slope
