"""The verdict, read off the posterior: none, named, a set, or unknown."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from simgap.attribution.invariance import Invariance
from simgap.attribution.posterior import Forms, Model

MOST = 0.5  # cited: share of the gap left from which on it is unknown (the interface's definition)
WIDTH = 0.25  # chosen: of that share's logarithm, logistic
MINOR = 0.1  # chosen: share of the whole gap; causes that explain less leave it unknown, wherever they act
LEAST = 0.02  # chosen: share of the explained gap below which an effect is told but is no cause
# cited: nats; "positive" evidence for one cause (Kass & Raftery, JASA 90, 1995)
POSITIVE = float(np.log(3.0))


def named_part(f: Forms, model: Model) -> tuple[int, ...]:
    """The effects of a set that have a name to give."""
    return tuple(j for j in model.effects if f.gap.candidates[j].named)


def known(left: float, explained: float, same: list[Invariance]) -> float:
    """Probability that a set's effects are the cause: they leave little, and are the same everywhere.

    `left`: share of the gap that the set leaves where it acts, `explained`: what it explains of all of it.
    Logistic in their logarithms; an effect whose parameters wander is as likely an imitation as the Bayes
    factor says.
    """
    most = expit(np.log(MOST / max(left, 1e-6)) / WIDTH)
    enough = expit(np.log(max(explained, 1e-6) / MINOR) / WIDTH)
    return float(most * enough * min((expit(i.log_bayes_factor) for i in same), default=1.0))


def alike(
    f: Forms,
    models: list[Model],
    weights: np.ndarray,
    causes: tuple[int, ...],
    parts: dict[tuple[int, ...], tuple[int, ...]],
) -> tuple[int, ...]:
    """Effects that take a cause's place in sets that are one in twenty as likely, or more.

    `parts`: the effects of each set that have a name.
    """
    first = max(
        (w for m, w in zip(models, weights, strict=True) if set(causes) <= set(parts[m.effects])), default=0.0
    )
    known_names, found = {f.gap.candidates[j].name for j in causes}, set[int]()
    for m, w in zip(models, weights, strict=True):
        mine = set(parts[m.effects])
        others = {j for j in mine if f.gap.candidates[j].name not in known_names}
        if w > first / 20 and others and len(mine) <= len(causes):
            found |= others
    return tuple(sorted(found))
