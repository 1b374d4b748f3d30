"""What intervals of a set's parameters are to hold beside the noise.

How far they scatter between logs, and what the effects do that held-out logs do not tell from one of the set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms


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


def of_causes(f: Forms, model: Model) -> dict[str, np.ndarray]:
    """Each effect of a model -> its parameters (k,)."""
    out = {}
    for j, mine in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        out[c.name] = c.neutral + c.scale * model.x[mine]
    return out


def over_rivals(f: Forms, model: Model, rivals: Sequence[tuple[Forms, Model]]) -> Model:
    """The set's model with what its parameters are in the sets that are not told from it, each as likely."""
    here, told = of_causes(f, model), [of_causes(*one) for one in rivals]
    more = np.zeros(model.x.size)
    for j, mine in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        apart = [(other[c.name] - here[c.name]) / c.scale for other in told if c.name in other]
        more[mine] = np.sum(np.square(apart), 0) / (1 + len(apart)) if apart else 0.0
    return replace(model, covariance=model.covariance + np.diag(more))
