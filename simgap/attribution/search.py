"""Which sets of effects to ask about: adding, removing and exchanging effects while that leads on.

Sets within a window of the best are kept (Occam's window: Madigan & Raftery, JASA 89, 1994).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simgap.attribution.posterior import Forms, Model, fitted, mode, quadratic_forms

# numerics: steps by which neighbours of a set are screened, how many of them are fitted
SCREEN, REFINED = 3, 5
WINDOW = 12.0  # numerics: nats behind the best set within which a set is kept
BEAM = 5  # numerics: sets of each size that are extended
MOST = 6  # numerics: effects of a set at most


def sought(
    f: Forms, beam: int = BEAM, named: bool = False, among: Sequence[int] | None = None
) -> list[Model]:
    """All sets found within the window of the best, best first; the empty set is always one.

    Neighbours of a set are screened from its mode in a few steps; those that lead are fitted to the end.
    `beam`: how many sets of the window are extended. `named`: of candidates that have a name alone.
    `among`: of these candidates alone.
    """
    every = range(len(f.gap.candidates)) if among is None else among
    among = [j for j in every if f.gap.candidates[j].named or not named]
    seen: dict[tuple[int, ...], Model] = {(): fitted(f, ()), **{(j,): fitted(f, (j,)) for j in among}}
    rough: set[tuple[int, ...]] = set()
    opened: set[tuple[int, ...]] = {()}
    while True:
        best = max(m.score for m in seen.values())
        ranked = sorted(seen.values(), key=lambda m: -m.score)
        leading = [m for m in ranked if m.score > best - WINDOW][:beam]
        leading += [m for m in ranked if len(m.effects) == 1][: 2 if beam > 1 else 0]
        todo = [m for m in leading if m.effects not in opened and len(m.effects) < MOST]
        if not todo:
            break
        for m in todo:
            opened.add(m.effects)
            new = [e for e in _neighbours(f, m.effects, among) if e not in seen and e not in rough]
            first = sorted(
                new, key=lambda e: -mode(f, quadratic_forms(f, e), m.precision, steps=SCREEN).score
            )
            seen |= {e: fitted(f, e) for e in first[:REFINED]}
            rough |= set(first[REFINED:])
    best = max(m.score for m in seen.values())
    kept = [m for m in seen.values() if m.score > best - WINDOW or not m.effects]
    return sorted(kept, key=lambda m: -m.score)


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
