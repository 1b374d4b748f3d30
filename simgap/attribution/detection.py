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
from simgap.attribution.posterior import Forms, Model, fitted
from simgap.attribution.search import sought

# prior: shares of groups off beside the usual one: a gap may be in one place alone
RARE = (0.002, 0.01, 0.03)
ENOUGH = 4  # cited: twins as extreme after which a p-value is clear (Besag & Clifford's h)
FEW, SURE = 4, 1e-6  # chosen: twins after which so small a chance is clear, if none is as extreme


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
    usual = [f.marginal(m.effects, m.energy)[0].sum() for m in wider]
    scores = [m.score for m in wider]
    for share in RARE:
        other = Background.usual(off=share)
        scores += [m.score + float(f.marginal(m.effects, m.energy, other)[0].sum() - now)
                   for m, now in zip(wider, usual, strict=True)]  # fmt: skip
    return float(np.logaddexp.reduce(scores) - np.log(len(RARE) + 1) - null)


def leniently(f: Forms, models: list[Model]) -> tuple[Forms, list[Model]]:
    """The same with what is below the tolerance as likely as not: whether there is a gap that matters."""
    other = replace(f, lenient=True)

    def score(m: Model) -> float:
        now, then = (each.marginal(m.effects, m.energy)[0].sum() for each in (f, other))
        return m.score + float(then - now)

    return other, [replace(m, score=score(m)) for m in models]


def detected(value: float, twins: Iterable[float] | None = None) -> Detection:
    """The chance of a healthy recording to show so large a statistic.

    By Markov's inequality healthy recordings exceed s with a probability of exp(-s) at most, times the
    expectation of their Bayes factor: one by theory, estimated on twins. What twins exceed is as likely as
    their ranks say; the larger of both counts. Twins are taken one by one until the answer is clear:
    ENOUGH exceed the recording's, or FEW leave no doubt.
    """
    p = float(np.exp(min(0.0, -value)))
    if twins is None:
        return Detection(value, p, 0.0)
    taken: list[float] = []
    exceed = 0
    for twin in twins:
        taken.append(float(twin))
        exceed += twin >= value
        expected = float(np.logaddexp.reduce([*taken, 0.0])) - np.log(len(taken) + 1)
        p = float(np.exp(min(0.0, max(expected, 0.0) - value)))
        if exceed >= ENOUGH or (len(taken) >= FEW and not exceed and p < SURE):
            break
    if not taken:
        return Detection(value, p, 0.0)
    if exceed:
        p = max(p, (exceed + 1) / (len(taken) + 1) if exceed < ENOUGH else exceed / len(taken))
    return Detection(value, p, 1 / (len(taken) + 1))
