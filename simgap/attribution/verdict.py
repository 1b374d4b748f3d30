"""The verdict, read off the posterior: none, named, a set, or unknown."""

from __future__ import annotations

import numpy as np

from simgap.attribution.invariance import Invariance
from simgap.attribution.posterior import Forms, Model

MOST = 0.5  # cited: share of the gap left from which on it is unknown (the interface's definition)
WIDTH = 0.25  # chosen: of that share's logarithm, logistic
LEAST = 0.02  # chosen: share of the explained gap below which an effect is told but is no cause
# cited: nats; "positive" evidence for one cause (Kass & Raftery, JASA 90, 1995)
POSITIVE = float(np.log(3.0))


def named_part(f: Forms, model: Model) -> tuple[int, ...]:
    """The effects of a set that have a name to give."""
    return tuple(j for j in model.effects if f.gap.candidates[j].named)


def known(left: float, same: list[Invariance]) -> float:
    """Probability that a set's effects are the cause: they leave little, and are the same everywhere.

    `left`: share of the gap that the set leaves. Logistic in its logarithm; an effect whose parameters
    wander is as likely an imitation as the Bayes factor says.
    """
    odds = np.log(MOST / max(left, 1e-6)) / WIDTH
    one = [1 / (1 + np.exp(-np.clip(i.log_bayes_factor, -50, 50))) for i in same]
    return float(1 / (1 + np.exp(-np.clip(odds, -50, 50))) * (min(one) if one else 1.0))


def alike(f: Forms, models: list[Model], weights: np.ndarray, causes: tuple[int, ...]) -> tuple[int, ...]:
    """Effects that take a cause's place in sets that are one in twenty as likely, or more."""
    first = max(
        (w for m, w in zip(models, weights, strict=True) if set(causes) <= set(m.effects)), default=0.0
    )
    known_names, found = {f.gap.candidates[j].name for j in causes}, set[int]()
    for m, w in zip(models, weights, strict=True):
        mine = set(named_part(f, m))
        others = {j for j in mine if f.gap.candidates[j].name not in known_names}
        if w > first / 20 and others and len(mine) <= len(causes):
            found |= others
    return tuple(sorted(found))
