"""What scatters residuals instead of shifting them: the variance that an effect adds, and how much of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from simgap.attribution.invariance import POSITIVE
from simgap.effects import fitted
from simgap.gap.problem import Problem


@dataclass(frozen=True)
class Scatter:
    """`variance` (n,) over the noise's that an effect of size `value` adds to each cosine coefficient of a
    cell (in the order of `assemble.rows_of`), log sd of that value, and evidence [nats] `known` of another
    kind. `same`: whether its size is the same everywhere. The variance of
    coefficients that it `frees` may be larger by so much (n,), whatever it is."""

    effect: str
    value: float
    log_sd: float
    variance: np.ndarray
    known: float = 0.0
    same: bool = True
    frees: np.ndarray | None = None


def on_grid(
    effect: str, square: np.ndarray, unit: np.ndarray, grid: np.ndarray, part: np.ndarray | None = None,
    spread: float = 0.0,
) -> Scatter:  # fmt: skip
    """The most likely size of a scatter with variance size^2 `unit` (n,), from squares (n,) of residuals.

    `part` (n,): numbers of parts in which one cause has one size, but for a log sd of `spread`. One that
    would have any other in each, by a Bayes factor of POSITIVE, or a size at the grid's end, is an imitation.
    """
    mine = np.flatnonzero(unit > 0)
    variance = 1 + grid[:, None] ** 2 * unit[mine]
    nats = 0.5 * (square[mine] * (1 - 1 / variance) - np.log(variance))
    score = nats.sum(1)
    best, weight = int(score.argmax()), np.exp(score - score.max())
    centre = np.average(np.log(grid), weights=weight)
    sd = max(float(np.sqrt(np.average((np.log(grid) - centre) ** 2, weights=weight))), 1e-3)
    known = float(np.log(np.mean(weight)))  # what the choice of its size costs: uniform over the grid
    same = best < grid.size - 1
    if part is not None:
        each = np.stack([np.bincount(part[mine], row) for row in nats])
        several = (np.logaddexp.reduce(each, axis=0) - np.log(grid.size)).sum()
        if spread > 0:
            near = norm.logpdf(np.log(grid), np.log(grid)[:, None], spread)
            near -= np.logaddexp.reduce(near, axis=1, keepdims=True)
            each = np.logaddexp.reduce(near[:, :, None] + each, axis=1)
        one = np.logaddexp.reduce(each.sum(1)) - np.log(grid.size)
        same = same and bool(one > several - POSITIVE)
    return Scatter(effect, float(grid[best]), sd, grid[best] ** 2 * unit, known, same)


def scatters(given: Problem, residual: np.ndarray, names: list[str]) -> list[Scatter]:
    """What each of the named effects that scatter adds to residuals (n,); not those that say nothing."""
    scattering: list[Callable] = [
        e.scatter for n, e in fitted().items() if n in names and e.scatter is not None
    ]
    found = [scatter(given, residual) for scatter in scattering]
    return [s for s in found if s is not None]
