"""What makes a reading of plain sequences probable: learned by maximum likelihood on drawn worlds.

The density of a true boundary is a mixture over readings of Laplace distributions about where each
puts it, plus a uniform share for truths that no reading has; the weights are those of
hmmseg.sequence.readings.probabilities.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from experiments.sequence_worlds import World
from hmmseg.sequence.features import feature_map, features
from hmmseg.sequence.labels import shares
from hmmseg.sequence.model import optional_states
from hmmseg.sequence.readings import (
    COARSE_CELLS,
    Reading,
    Weighing,
    coarse,
    find_readings,
    probabilities,
)


def readings_of(world: World) -> tuple[list[Reading], np.ndarray]:
    """Readings without labels, and true boundaries (num_trials, num_boundaries) as shares of the trials."""
    mapping = feature_map(world.trials, world.task.channels or tuple(world.trials[0].channels))
    data = [features(trial, mapping) for trial in world.trials]
    factor = max(1, round(float(np.median([len(each.values) for each in data])) / COARSE_CELLS))
    truth = np.array([shares(each, b) for each, b in zip(data, world.boundaries, strict=True)])
    found = find_readings([coarse(each.values, factor) for each in data], world.task.sequence,
                          optional_states(world.task, False), np.full(truth.shape, np.nan))  # fmt: skip
    return found, truth


def log_score(cases: list[tuple[list[Reading], np.ndarray]], parameters: np.ndarray) -> float:
    """Mean log density of the true boundaries; `parameters`: log independent, settled, shares, logit of the
    uniform share, log of the Laplace scale."""
    weighing = Weighing(float(np.exp(parameters[0])), float(parameters[1]), float(parameters[2]))
    elsewhere, scale = expit(parameters[3]), np.exp(parameters[4])
    total = []
    for readings, truth in cases:
        distance = np.abs(np.stack([r.ends for r in readings]) - truth)
        density = np.log((1 - elsewhere) * np.exp(-distance / scale) / (2 * scale) + elsewhere)
        weights = np.log(probabilities(readings, weighing) + np.finfo(float).tiny)
        total.append(logsumexp(weights[:, None, None] + density, axis=0).mean())
    return float(np.mean(total))


def learn(worlds: list[World]) -> dict:
    """Find and print what weighs readings best."""
    cases = [readings_of(world) for world in worlds]
    start = np.array([4.0, -2.0, 1.0, -2.0, -4.6])
    best = minimize(lambda p: -log_score(cases, p), start, method="BFGS", options={"eps": 1e-4})
    sd = np.sqrt(np.diag(best.hess_inv) / len(cases))
    found = {
        "worlds": len(worlds), "independent": float(np.exp(best.x[0])), "settled": float(best.x[1]),
        "shares": float(best.x[2]), "elsewhere": float(expit(best.x[3])), "scale": float(np.exp(best.x[4])),
        "log_score": float(-best.fun), "sd": sd[:3].tolist(),
    }  # fmt: skip
    print(found)
    return found
