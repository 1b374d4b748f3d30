"""Weights of the choices among changes of plain sequences, learned on drawn worlds.

By maximum likelihood of the true boundaries, whose density is the mixture over courses and choices that
`hmmseg segment` answers with (hmmseg.sequence.courses.Weighing): first without labels, then, for how far
boundaries lie off a change once labels have shown by how much, of the other trials with one of them labelled.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit

from experiments.sequence_worlds import World
from hmmseg.sequence.courses import (
    COARSE_CELLS,
    Course,
    Weighing,
    coarsen,
    find_courses,
    naming,
    probabilities,
)
from hmmseg.sequence.features import feature_map, features

START = (4.0, -3.0, 0.1, -5.0, -3.0, -2.0)  # numerics: where the search begins, as `weighing_of` takes it

Known = tuple[
    list[Course], np.ndarray, np.ndarray
]  # courses, labels, true boundaries as shares of the trials


def known(world: World, labelled: int) -> Known:
    """Courses of a world whose first trials are labelled."""
    mapping = feature_map(world.trials, world.task.channels or tuple(world.trials[0].channels))
    data = [features(trial, mapping) for trial in world.trials]
    factor = max(1, round(float(np.median([len(each.values) for each in data])) / COARSE_CELLS))
    truth = np.array([each.shares(b) for each, b in zip(data, world.boundaries, strict=True)])
    labels = np.where(np.arange(len(truth))[:, None] < labelled, truth, np.nan)
    found = find_courses(
        [coarsen(each.values, factor) for each in data], len(world.task.sequence), list(labels)
    )
    return found, labels, truth


def log_score(cases: list[Known], weighing: Weighing) -> float:
    """Mean log density of the true boundaries that are not labelled."""
    total = []
    for courses, labels, truth in cases:
        known_lag = np.isfinite(labels).any(0)
        scale = np.where(known_lag, weighing.labelled, weighing.lag)[:, None]
        open_ = ~np.isfinite(labels)
        namings = [naming(course, truth.shape[1] + 1, list(labels), weighing) for course in courses]
        density = np.zeros(truth.shape)
        for weight, course, found in zip(probabilities(namings), courses, namings, strict=True):
            off = truth[:, :, None] - course.ends[:, None]
            shift = np.where(open_[:, :, None], 0.0, off).sum(0) / np.maximum((~open_).sum(0), 1)[:, None]
            here = np.exp(-np.abs(off - shift) / scale) / (2 * scale)
            density += weight * (found.probability * here).sum(2)
        total.append(np.log((1 - weighing.elsewhere) * density + weighing.elsewhere)[open_].mean())
    return float(np.mean(total))


def weighing_of(x: np.ndarray) -> Weighing:
    """The weighing at unconstrained parameters."""
    return Weighing(
        independent=float(np.exp(x[0])), settled=float(x[1]), shares=float(x[2]),
        lag=float(np.exp(x[3])), labelled=float(np.exp(x[3])), elsewhere=float(expit(x[4])),
        unseen=float(expit(x[5])),
    )  # fmt: skip


def learn(worlds: list[World]) -> Weighing:
    """Fit and print the weighing."""
    worlds = [world for world in worlds if len(world.task.sequence) > 1]
    cases = [known(world, 0) for world in worlds]
    best: Any = minimize(lambda x: -log_score(cases, weighing_of(x)), np.array(START), method="BFGS",
                    options={"eps": 1e-3, "gtol": 2e-3, "maxiter": 25})  # fmt: skip
    found = weighing_of(best.x)
    sd = np.sqrt(np.diag(best.hess_inv) / len(cases))
    cases = [known(world, 1) for world in worlds if len(world.trials) > 1]
    known_lag: Any = minimize_scalar(lambda x: -log_score(cases, replace(found, labelled=float(np.exp(x)))),
                           bounds=(-9.0, -3.0), method="bounded", options={"xatol": 0.05})  # fmt: skip
    found = replace(found, labelled=float(np.exp(known_lag.x)))
    print({"worlds": len(worlds), "log_score": float(-best.fun), "sd": sd.tolist()} | asdict(found))
    return found
