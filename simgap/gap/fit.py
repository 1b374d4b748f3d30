"""Properties and effects fitted together, by Levenberg-Marquardt steps within the limits of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.bounded import least
from simgap.effects import free_parameters
from simgap.gap.evaluation import evaluated
from simgap.gap.problem import Problem, columns_of, limits

STEPS = 12  # numerics: of an iteration, at most
CLOSE = 0.02  # numerics: nats


@dataclass(frozen=True)
class Start:
    """A candidate's start: its effects and the coordinates (all columns) to start from."""

    effects: tuple[str, ...]
    u: np.ndarray


@dataclass(frozen=True)
class Fitted:
    """A fitted candidate: coordinates `u` (all columns), of which `columns` (K,) were free.

    `residual` (n,): what it leaves, whitened, in the order of the mask `whitening.weight > 0`; `push` (n, K)
    its derivatives; `doubts` [nats]: the cost of residuals in doubt; `cost`: these, half the squares with
    nuisances integrated out, and the prior.
    """

    effects: tuple[str, ...]
    u: np.ndarray
    columns: np.ndarray
    residual: np.ndarray
    push: np.ndarray
    doubts: float
    cost: float


def fit(given: Problem, start: Start, steps: int = STEPS) -> Fitted:
    """A start fitted by Levenberg-Marquardt; coordinates stay within their limits.

    Properties have normal priors, an effect's parameters together a Cauchy distribution.
    """
    mine, z = columns_of(given, start.effects), given.num_properties
    low, high = (edge[mine] for edge in limits(given))
    u = start.u.copy()
    u[mine] = np.clip(u[mine], low, high)
    blocks, at = [], z
    for key in start.effects:
        blocks.append(np.arange(at, at + len(free_parameters(key))))
        at += blocks[-1].size
    now, damping = evaluated(given, start.effects, u, mine, blocks), 1e-3
    for _ in range(steps):
        prior = np.ones(mine.size)
        for block in blocks:
            x = u[mine[block]]
            prior[block] = (1 + block.size) / (1 + x @ x)
        slope = given.product(now.push, now.residual) + now.lift + prior * u[mine]
        bend = given.product(now.push, now.push) + np.diag(prior)
        step, _ = least(bend + damping * np.diag(np.diag(bend)), -slope, low - u[mine], high - u[mine])
        trial = u.copy()
        trial[mine] = np.clip(u[mine] + step, low, high)
        new = evaluated(given, start.effects, trial, mine, blocks)
        if np.isfinite(new.cost) and new.cost < now.cost:
            gained, u, now, damping = now.cost - new.cost, trial, new, damping / 5
            if gained < CLOSE:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return Fitted(start.effects, u, mine, now.residual, now.push, now.doubts, now.cost)
