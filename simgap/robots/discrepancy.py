"""How far the model is off by itself: discrepancies' sizes by maximum likelihood.

One size for all windows of a regime. A size of each window's own, or heavy tails, would be found from the
residual that it then discounts: windows that happen to be met would decide by the sensors' noise, those in
which a cause shows would count for little, and where a search ends would hang on where it began.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from simgap.progress import say
from simgap.robots.blocks import NONE, Discrepancy
from simgap.robots.tied import Likelihood
from simgap.robots.whiten import Covariances

WORTH = 3.0  # chosen: nats that a discrepancy must gain to be there at all
# numerics: log variances are found to a hundredth of a nat
CLOSE = {"maxiter": 25, "ftol": 1e-6, "gtol": 0.05}


def learned(
    cov: Covariances, residual: np.ndarray, near: Discrepancy | None = None, begin: Discrepancy = NONE
) -> Discrepancy:
    """The discrepancy of a residual (N,); channels for which it gains nothing have none. `near`: that of a
    residual of which this one is a part, with which to begin; what that has none of, this has none of.
    `begin`: sizes to begin with in the place of those, or of a first guess."""
    names = cov.names
    if not names:
        return NONE
    sizes = _Sizes(cov.tied.of_residual(residual), len(names))
    kept = [k for k, name in enumerate(names) if near is None or name in near.scale]
    if near is not None:
        x = np.array([2 * np.log({**near.scale, **begin.scale}[names[k]]) for k in kept])
    else:
        x = sizes.first_guess({names.index(n): 2 * np.log(s) for n, s in begin.scale.items() if n in names})
    plain = sizes.value(np.zeros(0), [])
    while kept:
        bounds = [(v - 25.0, v + 12.0) for v in x]
        done = minimize(sizes.cost, x, (kept,), jac=True, method="L-BFGS-B", bounds=bounds, options=CLOSE)
        if plain - done.fun < WORTH:
            return NONE
        costs = [
            sizes.value(np.delete(done.x, i), kept[:i] + kept[i + 1 :]) - done.fun for i in range(len(kept))
        ]
        least = int(np.argmin(costs))
        if costs[least] >= WORTH:
            scale = {names[k]: float(np.exp(v / 2)) for k, v in zip(kept, done.x, strict=True)}
            return Discrepancy(scale)
        kept, x = kept[:least] + kept[least + 1 :], np.delete(done.x, least)
    return NONE


@dataclass(frozen=True)
class _Sizes:
    """The likelihood by log variances of those sources, of `count`, that are kept."""

    likelihood: Likelihood
    count: int

    def value(self, x: np.ndarray, kept: Sequence[int]) -> float:
        """Minus log likelihood."""
        return self.likelihood.value(self._variance(x, kept))

    def cost(self, x: np.ndarray, kept: Sequence[int]) -> tuple[float, np.ndarray]:
        """`value` and its gradient."""
        say("how far the model is off by itself")
        variance = self._variance(x, kept)
        value, slope = self.likelihood.slope(variance)
        return value, (variance * slope)[list(kept)]

    def first_guess(self, known: Mapping[int, float]) -> np.ndarray:
        """Log variances (K,): those that are known by number, and the others found one after another, each at
        most what alone would explain the residual."""
        numbers = [*known, *(k for k in range(self.count) if k not in known)]
        x = np.array([*known.values()], float)
        squares, trace = self.likelihood.squares, self.likelihood.tied.trace
        for at in range(len(known), self.count):
            mine, taken = trace[:, numbers[at]], trace[:, numbers[at]] > 0
            most = max(float(np.median(squares[taken] / mine[taken])), 1e-30) if taken.any() else 1e-26
            trial = [np.append(x, v) for v in np.log(most) - np.arange(0.0, 19.0, 3.0)]
            x = min(trial, key=lambda v, at=at: self.value(v, numbers[: at + 1]))
        return x[np.argsort(numbers)]

    def _variance(self, x: np.ndarray, kept: Sequence[int]) -> np.ndarray:
        """Variances (K,) of all sources, 0 for those that are not kept."""
        out = np.zeros(self.count)
        out[list(kept)] = np.exp(x)
        return out
