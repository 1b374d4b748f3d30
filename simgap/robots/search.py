"""Which effects act: search about a point, move the point to what was found, and search again there.

Each round is exact at its point (all effects found so far at their values) and linear about it. Leaders are
rolled out at their own best fit, so that what kinks at its neutral value is seen where it acts. Of many
candidates most are nowhere near: while the best set stays, those are asked that came near it when all were,
and before a search ends all are asked again where it would end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.progress import Progress, say
from simgap.robots.discrepancy import learned
from simgap.robots.fit import cost_at, moved_to
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.kept import NOWHERE, Kept
from simgap.robots.linear import Linear, base_at, linearise, numeric_at, vary
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.whiten import Covariances, Discrepancy, Whitener, covariances

ROUNDS = 10  # numerics: of an iteration that settles sooner
LEADERS = 24  # numerics: candidates that a search goes on with
SETTLED = 2.0  # numerics: nats that a further round must gain


@dataclass(frozen=True)
class Found:
    """Where a search ended: the linear model there, its whitener and discrepancies, the best set first."""

    linear: Linear
    whiten: Whitener
    covariances: Covariances
    discrepancy: Discrepancy
    forms: Forms
    models: tuple[Model, ...]
    best: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Candidates by number."""
        return tuple(c.name for c in self.forms.gap.candidates)


@dataclass(frozen=True)
class Step:
    """Where a search stands: about which point it goes on, the best set so far, and all that were best;
    `field`: the candidates that came near when all were asked; `whole`: all are asked next."""

    point: Point
    best: tuple[str, ...] = ()
    seen: frozenset[tuple[str, ...]] = frozenset()
    settled: bool = False
    field: tuple[str, ...] = ()
    whole: bool = True


def search(
    composed: Composed,
    phases: Phases,
    candidates: Sequence[str],
    tell: Progress,
    forced: Sequence[str] = (),
    factor: np.ndarray | None = None,
    kept: Kept = NOWHERE,
    plain: Linear | None = None,
) -> Found:
    """Search until the best set and its parameters stay: where there are many windows in some of them first,
    from which all are gone on with. `plain`: all candidates' sensitivities at a point, if they are known."""
    point: Point = {n: composed.effects[n].neutral() for n in fitted_along(composed)}
    begin = Step(point)
    few = composed.thinned()
    if not forced and len(few) < len(composed.windows):
        part, mine = composed.among(few), np.isin(composed.rows.window, few)
        noise = None if factor is None else factor[mine]
        known = None if plain is None else plain.among(part, mine)
        ask = _Ask(part, phases, tuple(candidates), (), noise, known)

        def ended() -> Step:
            found, last = _searched(ask, Step(_along(ask, point)), tell, kept.of("some windows"))
            there = point_of(part, found.forms, found.models[0].effects, found.linear.point)
            return Step(there, found.best, field=last.field, whole=False)

        begin = kept("some windows", ended)
    ask = _Ask(composed, phases, tuple(candidates), tuple(forced), factor, plain)
    if not begin.best:
        begin = Step(kept("fitted along", lambda: _along(ask, point)))
    return _searched(ask, begin, tell, kept)[0]


@dataclass(frozen=True)
class _Ask:
    """What a search is asked: in which windows, with which candidates, by which noise; `plain`: what is known
    of these windows at one point."""

    composed: Composed
    phases: Phases
    candidates: tuple[str, ...]
    forced: tuple[str, ...]
    factor: np.ndarray | None
    plain: Linear | None = None

    def asked(self, step: Step, number: int) -> tuple[str, ...]:
        """The candidates that a round asks: all in the last one."""
        near = {*step.field, *step.best}
        if step.whole or self.forced or number == ROUNDS - 1:
            return self.candidates
        return tuple(n for n in self.candidates if n in near)

    def linearised(self, point: Point, names: Sequence[str]) -> Linear:
        """All about a point; what is known there is not worked out again."""
        names = [*fitted_along(self.composed), *names]
        known = self.plain
        if known is not None and known.point == point and {*names} <= {*known.moved, *known.diverged}:
            return known
        return linearise(self.composed, point, names)

    def covariances(self, linear: Linear) -> Covariances:
        """Of the windows about a point."""
        return covariances(self.composed, linear, self.factor)


def _searched(ask: _Ask, step: Step, tell: Progress, kept: Kept) -> tuple[Found, Step]:
    """Rounds until the best set stays. A round that was kept is made again only if it is the last."""
    found: Found | None = None

    def made() -> Step:
        nonlocal found
        found, after = _round(ask, step, number)
        return after

    for number in range(ROUNDS):
        found = None
        tell(f"round {number + 1}")
        after = kept(f"round {number + 1}", made)
        tell(f"round {number + 1}: {' + '.join(after.best) or 'nothing'}")
        if after.settled:
            break
        step = after
    return _round(ask, step, number)[0] if found is None else found, after


def _along(ask: _Ask, point: Point) -> Point:
    """What is fitted along, without any cause."""
    for _ in range(2 if point else 0):
        rough = linearise(ask.composed, point, list(point))
        cov = ask.covariances(rough)
        point = moved_to(ask.composed, rough, cov.whitener(learned(cov, rough.residual)), point)
    return point


def _round(ask: _Ask, step: Step, number: int) -> tuple[Found, Step]:
    """One round: what is best about the step's point, and where to go on."""
    composed, asked = ask.composed, ask.asked(step, number)
    linear = ask.linearised(step.point, asked)
    usable = [n for n in asked if n in linear.moved]
    cov = ask.covariances(linear)
    off = learned(cov, linear.residual)
    whiten = cov.whitener(off)
    every = forms(gap_of(composed, linear, whiten, ask.phases, usable))
    linear, names = leaders(composed, linear, whiten, every, step.best)
    f = forms(gap_of(composed, linear, whiten, ask.phases, names))
    if ask.forced:
        chosen = tuple(j for j, n in enumerate(names) if n in ask.forced)
        models = [fitted(f, chosen), fitted(f, ())]
    else:
        models = [one_more(f, [names.index(n) for n in step.best if n in names])]
    now = tuple(sorted(names[j] for j in models[0].effects))
    found = Found(linear, whiten, cov, off, f, tuple(models), now)
    whole = len(asked) == len(ask.candidates)
    field = tuple(sorted({*names, *_nearest(every, now)})) if whole else step.field
    first = number == 0 and not step.best and bool(step.point)  # what is fitted along is yet to follow
    stays = now == step.best and not first
    settled = stays and _gain(found) < SETTLED
    again = now != step.best and now in step.seen  # sets that take turns are alike, and none will win
    last = settled or again or number == ROUNDS - 1
    if not last:
        there = point_of(composed, f, models[0].effects, step.point)
        point = moved_to(composed, linear, whiten, there)
        # The mode, by which the set is chosen, weighs groups by what they leave; the exact fit does not, so
        # that it may stay where the mode is not. A further round would then be this one again.
        costs = [cost_at(composed, linear, whiten, p) for p in (step.point, point)] if stays else [np.inf, 0]
        last = costs[0] - costs[1] < SETTLED
    if last:
        if not whole:
            return found, replace(step, whole=True)
        return found, replace(step, best=now, settled=True, field=field)
    # Whatever the set has gained or lost changes what comes near beside it; where it stays, that stays too.
    whole = now != step.best or len(field) == len(ask.candidates)
    return found, Step(point, now, step.seen | {now}, field=field, whole=whole)


def _nearest(f: Forms, best: Sequence[str]) -> list[str]:
    """The candidates that gain most beside these."""
    own = {c.name: j for j, c in enumerate(f.gap.candidates)}
    beside = [own[n] for n in best]
    gain = {n: fitted(f, tuple(sorted((*beside, j)))).score for n, j in own.items() if n not in best}
    return sorted(gain, key=lambda n: -gain[n])[:LEADERS]


def one_more(f: Forms, best: Sequence[int]) -> Model:
    """The best set with one effect more than these at most, or one exchanged or left out: what is far off is
    best moved towards in steps, each exact where it arrives."""
    every = range(len(f.gap.candidates))
    fewer = [tuple(j for j in best if j != out) for out in best]
    sets = {tuple(sorted({*kept, j})) for kept in (tuple(best), *fewer) for j in every} | {
        *fewer,
        tuple(best),
    }
    return max((fitted(f, effects) for effects in sorted(sets)), key=lambda m: m.score)


def _gain(found: Found) -> float:
    """What the best set would gain by moving its parameters from the point to its mode [nats], linearly."""
    gap, model = found.forms.gap, found.models[0]
    x = np.concatenate(
        [
            np.zeros(gap.nuisance.shape[1]),
            *[
                ((gap.candidates[j].at - gap.candidates[j].neutral) / gap.candidates[j].scale)
                for j in model.effects
            ],
        ]
    )
    z = gap.nuisance.shape[1]
    away = (model.x - x)[z:]
    if not away.size:
        return 0.0
    inner = np.linalg.inv(model.covariance[z:, z:] + 1e-12 * np.eye(away.size))
    return 0.5 * float(away @ inner @ away)


def point_of(composed: Composed, f: Forms, effects: Sequence[int], point: Point) -> Point:
    """Where these effects have their mode, and what is fitted along stays as in `point`."""
    model = fitted(f, tuple(effects))
    out = {n: dict(point[n]) for n in fitted_along(composed)}
    for j, mine in coordinates(f, model.effects).items():
        c = f.gap.candidates[j]
        values = np.clip(c.neutral + c.scale * model.x[mine], c.low, c.high)
        out[c.name] = dict(zip(c.parameters, values.tolist(), strict=True))
    return out


def leaders(
    composed: Composed, linear: Linear, whiten: Whitener, f: Forms, best: tuple[str, ...]
) -> tuple[Linear, list[str]]:
    """The candidates of `f` that gain most beside the best set, rolled out at their own best fits."""
    usable = [c.name for c in f.gap.candidates]
    held = [n for n in best if n in usable]
    own = {n: j for j, n in enumerate(usable)}
    with_best = tuple(sorted(own[n] for n in held))
    gains, at = {}, {}
    for name in usable:
        if name in held:
            continue
        effects = tuple(sorted((*with_best, own[name])))
        model = fitted(f, effects)
        gains[name] = model.score
        c = f.gap.candidates[own[name]]
        values = c.neutral + c.scale * model.x[coordinates(f, effects)[own[name]]]
        values = np.clip(values, c.low, c.high)
        # Straight lines are trusted to a few usual sizes only.
        values = np.clip(values, c.neutral - 5 * c.scale, c.neutral + 5 * c.scale)
        at[name] = dict(zip(c.parameters, values.tolist(), strict=True))
    first = sorted(gains, key=lambda n: -gains[n])[: max(LEADERS - len(held), 4)]
    base = numeric_at(composed, base_at(composed, linear.point))
    more = {}
    for name in sorted(first, key=lambda n: not composed.numeric(n)):
        say(f"{name} at its best")
        if all(
            abs(at[name][n] - p.nominal) < 1e-3 * p.sd for n, p in composed.effects[name].parameters.items()
        ):
            continue
        one = vary(composed, base, linear.starts, name, at[name])
        if one is not None:
            more[name] = one
    return linear.with_moved(more), sorted([*held, *first])
