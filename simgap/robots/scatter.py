"""How far a set's parameters scatter between logs, which their intervals are to hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, fitted, forms


def scattering(f: Forms, model: Model, fold: np.ndarray) -> Model:
    """The set's model with standard deviations of at least those that leaving out folds shows.

    Logs that agree within their likelihoods leave it as it is. Where the model is off by itself, each log
    tells another value, and their mean is no surer than their scatter (the jackknife of Quenouille and
    Tukey). `fold` (n,): of each row.
    """
    numbers = np.unique(fold)
    if numbers.size < 3 or not model.effects:
        return model
    gap = replace(f.gap, candidates=tuple(f.gap.candidates[j] for j in model.effects))
    every = tuple(range(len(model.effects)))
    left_out = np.array([fitted(forms(gap.taken(fold != n)), every).x for n in numbers])
    spread = np.sqrt((numbers.size - 1) * left_out.var(0))
    usual = np.sqrt(np.maximum(np.diag(model.covariance), 0.0))
    wider = np.where(usual > 0, np.maximum(spread / np.where(usual > 0, usual, 1.0), 1.0), 1.0)
    return replace(model, covariance=model.covariance * np.outer(wider, wider))
