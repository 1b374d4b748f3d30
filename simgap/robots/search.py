"""Which effects act: search about a point, move the point to what was found, and search again there.

Each round is exact at its point (all effects found so far at their values) and linear about it. Straight
lines promise what an exact fit may not keep: a set is gone on with if it scores better where it settles than
the one before did, so that scores rise and no sets take turns. Where there are many windows, a search of
some of them tells which candidates come near, and before it ends all are asked again where it would end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, fitted, forms
from simgap.progress import Progress, say
from simgap.robots.discrepancy import learned
from simgap.robots.fit import moved_to
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.judged import Judge, Judged
from simgap.robots.kept import NOWHERE, Kept
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.proposals import leaders, nearest, one_more, point_of
from simgap.robots.settle import SETTLED, settled
from simgap.robots.whiten import NONE, Covariances, Discrepancy, Whitener, covariances

ROUNDS = 10  # numerics: of an iteration that settles sooner
LEADERS = 24  # numerics: candidates that a search goes on with
PROPOSED = 4  # numerics: sets by each scale that are judged by the discrepancy that they leave
TRIED = 3  # numerics: sets that are fitted exactly until one is better


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
    """Where a search stands: about which point it goes on, and the best set so far, which settled there;
    `field`: the candidates that came near when all were asked; `whole`: all are asked next."""

    point: Point
    best: tuple[str, ...] = ()
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
    begin: Step | None = None,
) -> Found:
    """Search until the best set stays: where there are many windows in some of them first, from which all are
    gone on with. `plain`: all candidates' sensitivities where what is fitted along fits best without them, if
    they are known. `begin`: a set to go on from, in all windows."""
    ask = _Ask(composed, phases, tuple(candidates), tuple(forced), factor, plain)
    if begin is not None:
        return _searched(ask, begin, tell, kept)[0]
    few = composed.thinned()
    start = Step(kept("fitted along", ask.along))
    if not forced and len(few) < len(composed.windows):
        part, mine = composed.among(few), np.isin(composed.rows.window, few)
        noise = None if factor is None else factor[mine]
        known = None if plain is None else plain.among(part, mine)
        some = _Ask(part, phases, tuple(candidates), (), noise, known)

        def ended() -> Step:
            last = _searched(some, start, tell, kept.of("some windows"))[1]
            point = settled(composed, last.point, factor).point
            return Step(point, last.best, field=last.field, whole=False)

        start = kept("some windows", ended)
    return _searched(ask, start, tell, kept)[0]


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

    def settled(self, judge: Judge, point: Point, one: Judged) -> Point:
        """Where a set settles that was judged about a point."""
        f = self.forms(judge.linear, one.whiten, one.names)
        begin = point_of(self.composed, f, tuple(range(len(one.names))), point)
        first = moved_to(self.composed, judge.linear, one.whiten, begin)
        return settled(self.composed, first.point, self.factor).point

    def score(self, point: Point, names: tuple[str, ...], judge: Judge) -> float:
        """Of a set where it has settled; minus infinity where it diverges and the judge's point does not."""
        linear = linearise(self.composed, point, [*fitted_along(self.composed), *names])
        if linear.dropped > judge.linear.dropped or linear.diverged:
            return -np.inf
        cov = covariances(self.composed, linear, self.factor)
        near = learned(cov, linear.residual)
        return Judge(self.composed, self.phases, linear, cov, near, judge.log_odds)(names).score

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
    """One round: the sets that promise most about the step's point, and where the first that keeps what it
    promised settles."""
    composed, asked = ask.composed, ask.asked(step, number)
    linear = ask.linearised(step.point, asked)
    usable = [n for n in asked if n in linear.moved]
    cov = covariances(composed, linear, ask.factor)
    off = learned(cov, linear.residual)
    # What a cause does is hidden by the discrepancy that is left without it, and what is none of the causes'
    # doing misleads without one: what comes near by either is asked.
    scales = [cov.whitener(d) for d in ((off, NONE) if off else (NONE,))]
    every = [ask.forms(linear, whiten, usable) for whiten in scales]
    linear, names = leaders(composed, linear, every, ask.forced or step.best, LEADERS)
    held = tuple(n for n in names if n in (ask.forced or step.best))
    judge = Judge(composed, ask.phases, linear, cov, off, every[0].log_odds)
    here = judge(held)
    f = ask.forms(linear, here.whiten, names)
    model = fitted(f, tuple(names.index(n) for n in held))
    found = Found(linear, here.whiten, cov, here.discrepancy, f, (model,), held)
    if not {*held} <= {*step.point}:
        return found, Step(ask.settled(judge, step.point, here), held)
    if not ask.forced and number < ROUNDS - 1:
        sets = {tuple(names[j] for j in m.effects) for w in scales
                for m in one_more(ask.forms(linear, w, names), model.effects)[:PROPOSED]}  # fmt: skip
        promising = sorted(map(judge, sorted(sets - {held})), key=lambda one: -one.score)
        for one in [p for p in promising if p.score > here.score + SETTLED][:TRIED]:
            say(f"trying {' + '.join(one.names) or 'nothing'}")
            point = ask.settled(judge, step.point, one)
            if ask.score(point, one.names, judge) > here.score + SETTLED:
                return found, Step(point, one.names)
    # Whatever a set has gained or lost changes what comes near beside it.
    if len(asked) < len(ask.candidates):
        return found, replace(step, whole=True)
    return found, replace(step, ended=True, field=tuple(sorted({*names, *nearest(every, held)[:LEADERS]})))
