"""Whether there is a gap at all: a Bayes factor, whose inverse bounds the chance of a healthy recording.

Under the healthy model a Bayes factor against it exceeds b with a probability of 1 / b at most (an e-value:
Vovk & Wang, Ann. Stat. 49, 2021). A simulator is never quite the healthy model; healthy twins, taken through
the same statistic, say how far it is off (conformal rank: Besag & Clifford, Biometrika 78, 1991).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.background import Background
from simgap.attribution.posterior import Forms, Model, fitted, sought

RARE = (0.002, 0.01, 0.03)  # shares of groups off beside the usual one: a gap may be in one place alone
ENOUGH = 10  # twins as extreme after which a p-value is clear (Besag & Clifford's h)


@dataclass(frozen=True)
class Detection:
    """`statistic`: log Bayes factor [nats] of a gap; `p_value`; `resolution`: the smallest p that could have
    been seen, 0 where no twins were taken."""

    statistic: float
    p_value: float
    resolution: float


def statistic(f: Forms, models: list[Model] | None = None, acting: tuple[int, ...] = ()) -> float:
    """Log Bayes factor of a gap beside the effects that are `acting`, by others or the background, against
    these effects and stated noise alone."""
    models = sought(f) if models is None else models
    wider = [m for m in models if {*acting} <= {*m.effects}]
    wider += [] if any(m.effects == acting for m in wider) else [fitted(f, acting)]
    null = fitted(replace(f, background=Background.usual(off=1e-9)), acting).score
    usual = [f.background.marginal(m.energy, f.count, f.shift(m.effects))[0].sum() for m in wider]
    scores = [m.score for m in wider]
    for share in RARE:
        other = Background.usual(off=share)
        scores += [m.score + float(other.marginal(m.energy, f.count, f.shift(m.effects))[0].sum() - now)
                   for m, now in zip(wider, usual, strict=True)]  # fmt: skip
    return float(np.logaddexp.reduce(scores) - np.log(len(RARE) + 1) - null)


def detected(value: float, twins: Iterable[float] | None = None) -> Detection:
    """The chance of a healthy recording to show so large a statistic.

    Twins are taken one by one until ENOUGH exceed the recording's, or there are no more.
    """
    if twins is None:
        return Detection(value, float(np.exp(min(0.0, -value))), 0.0)
    exceed = number = 0
    for twin in twins:
        number += 1
        exceed += twin >= value
        if exceed >= ENOUGH:
            return Detection(value, exceed / number, 1 / (number + 1))
    return Detection(value, (exceed + 1) / (number + 1), 1 / (number + 1))
