"""Which sets of effects to ask about: what gains most beside a set, about a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted
from simgap.progress import say
from simgap.robots.gap import fitted_along
from simgap.robots.linear import Linear, base_at, vary
from simgap.robots.model import Composed, Point

FAR = 5.0  # numerics: usual sizes
REFINED = 8  # numerics: sets of those with the same effects left that are fitted to the end
FEWEST = 4  # numerics: candidates that are asked beside a set, however large it is


def nearest(every: Sequence[Forms], best: Sequence[str]) -> list[str]:
    """Candidates by what they gain beside these, by their better rank in any of these forms, first first."""
    return ranked([_gains(f, best)[0] for f in every])


def _gains(
    f: Forms, best: Sequence[str], without: Sequence[str] = ()
) -> tuple[dict[str, float], dict[str, Model]]:
    """Of every candidate beside these the score and the model; of those in `without` none."""
    own = {c.name: j for j, c in enumerate(f.gap.candidates)}
    beside = [own[n] for n in best if n in own]
    models = {n: fitted(f, tuple(sorted((*beside, j)))) for n, j in own.items() if n not in {*best, *without}}
    return {n: m.score for n, m in models.items()}, models


def ranked(gains: Sequence[Mapping[str, float]]) -> list[str]:
    """Names by their better rank in several scores, best first."""
    ranks = [sorted(one, key=lambda n: -one[n]) for one in gains]
    return list(dict.fromkeys(name for level in zip(*ranks, strict=True) for name in level))


def one_more(f: Forms, best: Sequence[int]) -> list[Model]:
    """Sets with one effect more than these at most, or one exchanged or left out, best first: what is far off
    is best moved towards in steps, each exact where it arrives."""
    every = range(len(f.gap.candidates))
    fewer = [tuple(j for j in best if j != out) for out in best]
    sets = {tuple(sorted({*kept, j})) for kept in (tuple(best), *fewer) for j in every} | {
        *fewer,
        tuple(best),
    }
    return sorted((fitted(f, effects) for effects in sorted(sets)), key=lambda m: -m.score)


def point_of(composed: Composed, f: Forms, effects: Sequence[int], point: Point) -> Point:
    """Where these effects have their mode, and what is fitted along stays as in `point`."""
    model = fitted(f, tuple(effects))
    out = {n: dict(point[n]) for n in fitted_along(composed)}
    for j, mine in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        values = np.clip(c.neutral + c.scale * model.x[mine], c.low, c.high)
        out[c.name] = dict(zip(c.parameters, values.tolist(), strict=True))
    return out


def two_more(f: Forms, best: Sequence[int]) -> list[Model]:
    """Sets with two effects more than these, or one exchanged for two, best first: what helps only together,
    and what one effect stands in for. Those are fitted that are left by least squares to lead."""
    now = fitted(f, tuple(sorted(best)))
    product = np.tensordot(now.precision, f.product, 1)
    others = [j for j in range(len(f.gap.candidates)) if j not in best]
    beside = [tuple(best), *(tuple(j for j in best if j != out) for out in best)]
    found: list[Model] = []
    for kept in beside:
        sets = [tuple(sorted((*kept, *pair))) for pair in combinations(others, 2)]
        sets.sort(key=lambda effects: _left(f, product, effects))
        found += [fitted(f, effects) for effects in sets[:REFINED]]
    return sorted(found, key=lambda m: -m.score)


def _left(f: Forms, product: np.ndarray, effects: tuple[int, ...]) -> float:
    """Squares that a set leaves with a prior of the usual size; `product`: of all columns."""
    own = f.spectrum.own
    free = [*range(1, 1 + f.spectrum.num_nuisances), *(k for j in effects for k in own[j][1:])]
    constant = [0, *(own[j][0] for j in effects)]
    sign = np.array([1.0, *(-1.0 for _ in effects)])
    pull = sign @ product[np.ix_(constant, free)]
    bend = product[np.ix_(free, free)] + np.eye(len(free))
    return float(sign @ product[np.ix_(constant, constant)] @ sign - pull @ np.linalg.solve(bend, pull))


def leaders(
    composed: Composed, linear: Linear, every: Sequence[Forms], best: Sequence[str], count: int
) -> tuple[Linear, list[str]]:
    """The candidates that gain most by any of these forms, beside the best set or in the place of one of it
    (what does the same gains nothing beside it), about `count` with it, rolled out at their own best fits so
    that what kinks at its neutral value is seen where it acts; and the set."""
    held = [n for n in best if n in linear.moved]
    beside = [held, *([n for n in held if n != out] for out in held)]
    told = [(f, *_gains(f, kept, held)) for kept in beside for f in every]
    first = ranked([gains for _, gains, _ in told])[: max(count - len(held), FEWEST)]
    place = [{n: k for k, n in enumerate(ranked([gains]))} for _, gains, _ in told]
    base = base_at(composed, linear.point)
    more = {}
    for name in first:
        say(f"{name} at its best")
        f, _, models = told[int(np.argmin([rank[name] for rank in place]))]
        at = _best_of(f, models[name], name)
        known = composed.effects[name].parameters
        if all(abs(at[n] - p.nominal) < 1e-3 * p.sd for n, p in known.items()):
            continue
        one = vary(composed, base, linear.starts, name, at)
        if one is not None:
            more[name] = one
    return linear.with_moved(more), sorted([*held, *first])


def _best_of(f: Forms, model: Model, name: str) -> dict[str, float]:
    """An effect's parameters in a model; straight lines are trusted to a few usual sizes only."""
    number = next(j for j in model.effects if f.gap.candidates[j].name == name)
    c = f.gap.candidates[number]
    values = np.clip(c.neutral + c.scale * model.x[coordinates(f, model.effects)[number]], c.low, c.high)
    values = np.clip(values, c.neutral - FAR * c.scale, c.neutral + FAR * c.scale)
    return dict(zip(c.parameters, values.tolist(), strict=True))
