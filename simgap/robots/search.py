"""Which effects act: search about a point, move the point to what was found, and search again there.

Each round is exact at its point (all effects found so far at their values) and linear about it. Leaders are
rolled out at their own best fit, so that what kinks at its neutral value is seen where it acts. Of many
candidates most are nowhere near: while the best set stays, those are asked that came near it when all were,
and before a search ends all are asked again where it would end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.progress import Progress, say
from simgap.robots.discrepancy import learned
from simgap.robots.fit import moved_to
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.judged import Judge
from simgap.robots.kept import NOWHERE, Kept
from simgap.robots.linear import Linear, base_at, linearise, numeric_at, vary
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.settle import settled
from simgap.robots.whiten import NONE, Covariances, Discrepancy, Whitener, covariances

ROUNDS = 10  # numerics: of an iteration that settles sooner
LEADERS = 24  # numerics: candidates that a search goes on with
PROPOSED = 4  # numerics: sets by each scale that are judged by the discrepancy that they leave
FAR = 5.0  # numerics: usual sizes


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
    ended: bool = False
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
    """Search until the best set stays: where there are many windows in some of them first, from which all are
    gone on with. `plain`: all candidates' sensitivities where what is fitted along fits best without them, if
    they are known."""
    ask = _Ask(composed, phases, tuple(candidates), tuple(forced), factor, plain)
    begin = Step(kept("fitted along", ask.along))
    few = composed.thinned()
    if not forced and len(few) < len(composed.windows):
        part, mine = composed.among(few), np.isin(composed.rows.window, few)
        noise = None if factor is None else factor[mine]
        known = None if plain is None else plain.among(part, mine)
        some = _Ask(part, phases, tuple(candidates), (), noise, known)

        def ended() -> Step:
            last = _searched(some, begin, tell, kept.of("some windows"))[1]
            point = settled(composed, last.point, factor).point
            return Step(point, last.best, field=last.field, whole=False)

        begin = kept("some windows", ended)
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

    def along(self) -> Point:
        """What is fitted along, without any cause."""
        if self.plain is not None:
            return self.plain.point
        neutral = {n: self.composed.effects[n].neutral() for n in fitted_along(self.composed)}
        return settled(self.composed, neutral, self.factor).point

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

    def forms(self, linear: Linear, whiten: Whitener, names: Sequence[str]) -> Forms:
        """The gap about a point, of these candidates."""
        return forms(gap_of(self.composed, linear, whiten, self.phases, names))


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
        if after.ended:
            break
        step = after
    return _round(ask, step, number)[0] if found is None else found, after


def _round(ask: _Ask, step: Step, number: int) -> tuple[Found, Step]:
    """One round: what is best about the step's point, and where that settles."""
    composed, asked = ask.composed, ask.asked(step, number)
    linear = ask.linearised(step.point, asked)
    usable = [n for n in asked if n in linear.moved]
    cov = covariances(composed, linear, ask.factor)
    off = learned(cov, linear.residual)
    # What a cause does is hidden by the discrepancy that is left without it, and what is none of the causes'
    # doing misleads without one: what comes near by either is asked.
    scales = [cov.whitener(d) for d in ((off, NONE) if off else (NONE,))]
    every = [ask.forms(linear, whiten, usable) for whiten in scales]
    linear, names = leaders(composed, linear, every, ask.forced or step.best)
    held = tuple(n for n in names if n in (ask.forced or step.best))
    judge = Judge(composed, ask.phases, linear, cov, off, every[0].log_odds)
    sets = {held}
    if not ask.forced:
        for whiten in scales:
            f = ask.forms(linear, whiten, names)
            near = one_more(f, [names.index(n) for n in held])[:PROPOSED]
            sets |= {tuple(names[j] for j in model.effects) for model in near}
    judged = {one: judge(one) for one in sorted(sets)}
    best = max(judged.values(), key=lambda one: one.score)
    # Sets that take turns are alike, and none will win.
    ends = {*best.names} == {*held} or tuple(sorted(best.names)) in step.seen or number == ROUNDS - 1
    ends = ends and {*held} <= {*step.point}
    best = judged[held] if ends else best
    f = ask.forms(linear, best.whiten, names)
    model = fitted(f, tuple(names.index(n) for n in best.names))
    now = tuple(sorted(best.names))
    found = Found(linear, best.whiten, cov, best.discrepancy, f, (model,), now)
    whole = len(asked) == len(ask.candidates)
    field = tuple(sorted({*names, *_nearest(every, now)})) if whole else step.field
    if ends:
        return found, replace(step, ended=whole, field=field, whole=True)
    first = moved_to(composed, linear, best.whiten, point_of(composed, f, model.effects, step.point))
    point = settled(composed, first.point, ask.factor).point
    # Whatever the set has gained or lost changes what comes near beside it.
    return found, Step(point, now, step.seen | {now}, field=field)


def _nearest(every: Sequence[Forms], best: Sequence[str]) -> list[str]:
    """The candidates that gain most beside these, by either scale."""
    return _ranked([_gains(f, best)[0] for f in every])[:LEADERS]


def _gains(f: Forms, best: Sequence[str]) -> tuple[dict[str, float], dict[str, Model]]:
    """Of every candidate beside these the score and the model."""
    own = {c.name: j for j, c in enumerate(f.gap.candidates)}
    beside = [own[n] for n in best if n in own]
    models = {n: fitted(f, tuple(sorted((*beside, j)))) for n, j in own.items() if n not in best}
    return {n: m.score for n, m in models.items()}, models


def _ranked(gains: Sequence[Mapping[str, float]]) -> list[str]:
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


def leaders(
    composed: Composed, linear: Linear, every: Sequence[Forms], best: Sequence[str]
) -> tuple[Linear, list[str]]:
    """The candidates that gain most beside the best set by any of these forms, rolled out at their own best
    fits, and all of the set that there are."""
    held = [n for n in best if n in linear.moved]
    told = [_gains(f, held) for f in every]
    first = _ranked([gains for gains, _ in told])[: max(LEADERS - len(held), 4)]
    base = numeric_at(composed, base_at(composed, linear.point))
    more = {}
    for name in sorted(first, key=lambda n: not composed.numeric(n)):
        say(f"{name} at its best")
        place = [sorted(gains, key=lambda n, gains=gains: -gains[n]).index(name) for gains, _ in told]
        f, models = every[int(np.argmin(place))], told[int(np.argmin(place))][1]
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
