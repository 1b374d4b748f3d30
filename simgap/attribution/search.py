"""The search for sets of effects: effects are added, removed and exchanged while that leads on.

Sets within a window of the best are kept (Occam's window: Madigan & Raftery, JASA 89, 1994).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

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

# numerics: neighbours of a set refined after screening, steps of this refinement, and neighbours then fitted
SHORT, SCREEN, REFINED = 16, 3, 5
WINDOW = 12.0  # numerics: nats below the best set within which a set is kept
BEAM = 5  # numerics: sets that are extended
MOST = 6  # numerics: most effects in a set


def sought(f: Forms) -> list[Model]:
    """Find the sets of effects within a window of the best.

    The neighbours of a set are screened from its mode in one step, the leading ones refined in a few, and
    what leads then is fitted until it converges. Of a set whose effects were linearised at several points the
    best counts.

    Args:
        f: Quadratic forms of the gap.

    Returns:
        The sets, best first; the empty set is always one of them.
    """
    seen: dict[tuple[int, ...], Model] = {(): fitted(f, ())}
    seen |= {(j,): fitted(f, (j,)) for j, c in enumerate(f.gap.candidates) if not c.beside}
    rough: set[tuple[int, ...]] = set()
    opened: set[tuple[int, ...]] = {()}
    # The effect that leaves the least squares may be the larger of two causes although others score higher as
    # long as the smaller one is unexplained: a background that is off everywhere costs little.
    singles = [m for m in seen.values() if m.effects]
    alone = min(singles, key=lambda m: float(m.energy.sum()), default=seen[()])
    while True:
        best = max(m.score for m in seen.values())
        ranked = sorted(seen.values(), key=lambda m: -m.score)
        leading = [alone, *[m for m in ranked if m.score > best - WINDOW][:BEAM]]
        leading += [m for m in ranked if len(m.effects) == 1][:2]
        todo = [m for m in leading if m.effects not in opened and len(m.effects) < MOST]
        if not todo:
            break
        for m in todo:
            opened.add(m.effects)
            new = [e for e in _neighbours(f, m.effects) if e not in seen and e not in rough]
            likely = [new[k] for k in np.argsort(-screened(f, m, new), kind="stable")[:SHORT]]
            found = [mode(f, quadratic_forms(f, e), m.precision, steps=SCREEN) for e in likely]
            first = sorted(found, key=lambda m: -m.score)[:REFINED]
            seen |= {m.effects: fitted(f, m.effects) for m in first}
            rough |= {*new} - {*seen}
    best, kept = max(m.score for m in seen.values()), dict[tuple[Any, ...], Model]()
    for m in sorted(seen.values(), key=lambda m: -m.score):
        if m.score > best - WINDOW or not m.effects:
            kept.setdefault(tuple(sorted(f.gap.candidates[j].form_of for j in m.effects)), m)
    return list(kept.values())


def _neighbours(f: Forms, effects: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Sets with one effect added, removed or exchanged; only one form of an effect acts."""
    of = f.gap.candidates
    forms = [j for j, c in enumerate(of) if not c.beside]
    mine = [
        i if not of[i].beside else next(j for j in forms if of[j].form_of == of[i].form_of) for i in effects
    ]
    fewer = [[j for j in mine if j != out] for out in mine]
    more = [
        [*e, j]
        for e in (mine, *fewer)
        for j in forms
        if j not in mine and of[j].name not in {of[i].name for i in e}
    ]
    return list(dict.fromkeys(_linearised(f, e) for e in (*more, *fewer)))


def _linearised(f: Forms, effects: Sequence[int]) -> tuple[int, ...]:
    """The same forms of effects, each as linearised beside those that are most like the rest of the set."""
    of, out = f.gap.candidates, []
    for j in effects:
        rest = {of[i].name for i in effects} - {of[j].name}
        same = [j, *(i for i, c in enumerate(of) if c.form_of == of[j].form_of)]
        out.append(min(same, key=lambda i: len({*of[i].beside} ^ rest)))
    return tuple(sorted(out))


def weights(models: list[Model]) -> np.ndarray:
    """Posterior probabilities of the sets; they sum to 1."""
    score = np.array([m.score for m in models])
    return np.exp(score - np.logaddexp.reduce(score))


# Whether there is a gap at all: a Bayes factor, whose inverse bounds the p-value.
#
# Under the healthy model a Bayes factor against it exceeds b with a probability of at most 1 / b (an e-value:
# Vovk & Wang, Ann. Stat. 49, 2021). No model is exactly right: where there are healthy recordings, their
# statistics tell by how much the bound is off (conformal rank: Besag & Clifford, Biometrika 78, 1991).

ENOUGH = 4  # cited: healthy ones as extreme after which a p-value is clear (Besag & Clifford's h)
SURE = 1e-6  # chosen: p-value that is clear even if the next one were twice as extreme as those before


@dataclass(frozen=True)
class Detection:
    """The test for a gap.

    Attributes:
        statistic: Log Bayes factor of a gap [nats].
        p_value: Probability that a healthy recording shows so large a statistic.
        resolution: Smallest p-value that ranks among healthy recordings could have given; 0 without any.
    """

    statistic: float
    p_value: float
    resolution: float

    @property
    def unseen(self) -> float:
        """Probability of a gap that raises no alarm, from its Bayes factor at even prior odds."""
        return float(expit(min(self.statistic, 0.0)))


def statistic(f: Forms, models: list[Model] | None = None, acting: tuple[int, ...] = ()) -> float:
    """Log Bayes factor [nats] of a gap beyond the effects in `acting`.

    Further effects or the background explain it; the alternative is these effects with the stated noise
    alone.
    """
    models = sought(f) if models is None else models
    wider = [m for m in models if {*acting} <= {*m.effects}]
    wider += [] if any(m.effects == acting for m in wider) else [fitted(f, acting)]
    null = fitted(replace(f, background=Background.usual(1e-9)), acting).score
    return float(np.logaddexp.reduce([m.score for m in wider]) - null)


def clear(value: float, most: float) -> bool:
    """Whether a statistic is surely a gap, even if a healthy one reached twice the largest seen (`most`)."""
    return max(0.0, most) < (value + float(np.log(SURE))) / 2


def detected(value: float, healthy: Iterable[float] = ()) -> Detection:
    """Test for a gap, by theory or against healthy recordings.

    By Markov's inequality a healthy recording exceeds s with a probability of at most exp(-s) times the
    expectation of its Bayes factor: one in theory, estimated from healthy ones. The rank among these gives a
    second p-value; the larger of the two counts.

    Args:
        value: The statistic of the recording [nats].
        healthy: Statistics of healthy recordings. They are drawn one by one until the answer is clear: ENOUGH
            exceed the recording's, or a next one twice as extreme would leave no doubt.
    """
    p = float(np.exp(min(0.0, -value)))
    taken: list[float] = []
    exceed = 0
    for other in healthy:
        taken.append(float(other))
        exceed += other >= value
        expected = float(np.logaddexp.reduce([*taken, 0.0])) - np.log(len(taken) + 1)
        p = float(np.exp(min(0.0, max(expected, 0.0) - value)))
        if exceed >= ENOUGH or clear(value, max(taken)):
            break
    if not taken:
        return Detection(value, p, 0.0)
    if exceed:
        p = max(p, (exceed + 1) / (len(taken) + 1) if exceed < ENOUGH else exceed / len(taken))
    return Detection(value, p, 1 / (len(taken) + 1))
