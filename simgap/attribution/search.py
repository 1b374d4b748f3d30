"""Which sets of effects to ask about: adding, removing and exchanging effects while that leads on.

Sets within a window of the best are kept (Occam's window: Madigan & Raftery, JASA 89, 1994).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from simgap.attribution.posterior import (
    Background,
    Forms,
    Model,
    fitted,
    mode,
    quadratic_forms,
    screened,
)

# numerics: how many of a set's neighbours lead after one step, steps that these take, how many are fitted
SHORT, SCREEN, REFINED = 16, 3, 5
WINDOW = 12.0  # numerics: nats behind the best set within which a set is kept
BEAM = 5  # numerics: sets of each size that are extended
MOST = 6  # numerics: effects of a set at most


def sought(f: Forms, beam: int = BEAM, among: Sequence[int] | None = None) -> list[Model]:
    """All sets found within the window of the best, best first; the empty set is always one. Of a set whose
    effects were linearised at several places the best counts.

    Neighbours of a set are screened from its mode in one step, leading ones in a few; what leads then is
    fitted to the end.
    `beam`: how many sets of the window are extended. `among`: of these candidates alone.
    """
    among = list(range(len(f.gap.candidates)) if among is None else among)
    seen: dict[tuple[int, ...], Model] = {(): fitted(f, ()), **{(j,): fitted(f, (j,)) for j in among}}
    rough: set[tuple[int, ...]] = set()
    opened: set[tuple[int, ...]] = {()}
    # What leaves the least squares may be the larger of two causes, though others score higher while the
    # smaller one is there: a background that is off everywhere costs little.
    alone = min((seen[(j,)] for j in among), key=lambda m: float(m.energy.sum()), default=seen[()])
    while True:
        best = max(m.score for m in seen.values())
        ranked = sorted(seen.values(), key=lambda m: -m.score)
        leading = [alone, *[m for m in ranked if m.score > best - WINDOW][:beam]]
        leading += [m for m in ranked if len(m.effects) == 1][: 2 if beam > 1 else 0]
        todo = [m for m in leading if m.effects not in opened and len(m.effects) < MOST]
        if not todo:
            break
        for m in todo:
            opened.add(m.effects)
            new = [e for e in _neighbours(f, m.effects, among) if e not in seen and e not in rough]
            likely = [new[k] for k in np.argsort(-screened(f, m, new), kind="stable")[:SHORT]]
            found = [mode(f, quadratic_forms(f, e), m.precision, steps=SCREEN) for e in likely]
            first = sorted(found, key=lambda m: -m.score)[:REFINED]
            seen |= {m.effects: fitted(f, m.effects) for m in first}
            rough |= {*new} - {*seen}
    best, of = max(m.score for m in seen.values()), f.gap.candidates
    kept: dict[tuple, Model] = {}
    for m in sorted(seen.values(), key=lambda m: -m.score):
        if m.score > best - WINDOW or not m.effects:
            kept.setdefault(tuple(sorted((of[j].name, of[j].parameters) for j in m.effects)), m)
    return list(kept.values())


def _neighbours(f: Forms, effects: tuple[int, ...], among: list[int]) -> list[tuple[int, ...]]:
    """Sets with one effect more, one left out, or one exchanged; of one name's forms only one acts."""
    names = [c.name for c in f.gap.candidates]
    fewer = [tuple(j for j in effects if j != out) for out in effects]
    more = [
        tuple(sorted({*e, j}))
        for e in (effects, *fewer)
        for j in among
        if j not in effects and names[j] not in {names[i] for i in e}
    ]
    return list(dict.fromkeys([*more, *fewer]))


def weights(models: list[Model]) -> np.ndarray:
    """Posterior probabilities of the sets, which sum to 1."""
    score = np.array([m.score for m in models])
    return np.exp(score - np.logaddexp.reduce(score))


# Whether there is a gap at all: a Bayes factor, whose inverse bounds the chance of a healthy recording.
#
# Under the healthy model a Bayes factor against it exceeds b with a probability of 1 / b at most (an e-value:
# Vovk & Wang, Ann. Stat. 49, 2021). A simulator is never quite the healthy model; healthy twins, taken
# through the same statistic, say how far it is off (conformal rank: Besag & Clifford, Biometrika 78, 1991).

# prior: shares of groups off, besides the usual one: a gap may be in one place alone
RARE = (0.002, 0.01, 0.03)
ENOUGH = 4  # cited: twins as extreme after which a p-value is clear (Besag & Clifford's h)
SURE = 1e-6  # chosen: so small a chance is clear, were the next twin twice as far as those before


@dataclass(frozen=True)
class Detection:
    """`statistic`: log Bayes factor [nats] of a gap; `p_value`; `resolution`: the smallest p that could have
    been seen, 0 where no twins were taken."""

    statistic: float
    p_value: float
    resolution: float

    @property
    def unseen(self) -> float:
        """Probability of a gap where it raises no alarm: by its Bayes factor, with even odds beforehand."""
        return float(expit(min(self.statistic, 0.0)))


def statistic(f: Forms, models: list[Model] | None = None, acting: tuple[int, ...] = ()) -> float:
    """Log Bayes factor of a gap beyond the effects that are `acting`, by others or the background, against
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


def clear(value: float, most: float) -> bool:
    """Whether a statistic is that of a gap for certain, were a healthy one twice the `most` that was seen."""
    return max(0.0, most) < doubtful(value)


def doubtful(value: float) -> float:
    """The least statistic [nats] of a healthy recording that leaves a gap's `value` in doubt."""
    return (value + float(np.log(SURE))) / 2


def detected(value: float, twins: Iterable[float] | None = None) -> Detection:
    """The chance of a healthy recording to show so large a statistic.

    By Markov's inequality healthy recordings exceed s with a probability of exp(-s) at most, times the
    expectation of their Bayes factor: one by theory, estimated on twins. What twins exceed is as likely as
    their ranks say; the larger of both counts. Twins are taken one by one until the answer is clear:
    ENOUGH exceed the recording's, or another one twice as far as they are would leave no doubt.
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
        if exceed >= ENOUGH or clear(value, max(taken)):
            break
    if not taken:
        return Detection(value, p, 0.0)
    if exceed:
        p = max(p, (exceed + 1) / (len(taken) + 1) if exceed < ENOUGH else exceed / len(taken))
    return Detection(value, p, 1 / (len(taken) + 1))
