"""Which effects act: search about a point, move the point to what was found, and search again there.

Each round is exact at its point (all effects found so far at their values) and linear about it. Straight
lines promise what an exact fit may not keep: a set is gone on with if it scores better where it settles than
the one before did, so that scores rise and no sets take turns. Where there are many windows, a search of
some of them tells which candidates come near, and before it ends all are asked again where it would end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simgap.attribution.posterior import Forms, Model, fitted
from simgap.attribution.verdict import LEAST
from simgap.progress import Progress, say
from simgap.robots.asked import ROUNDS, Asked, Step
from simgap.robots.blocks import NONE, Discrepancy
from simgap.robots.borne_out import BORNE_OUT, EVEN, chance_of, held_out_scores
from simgap.robots.discrepancy import learned
from simgap.robots.fit import Fit, reached
from simgap.robots.gap import fitted_along
from simgap.robots.judged import Judge, Judged
from simgap.robots.kept import NOWHERE, Kept
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Point
from simgap.robots.proposals import leaders, nearest, one_more, point_of, two_more
from simgap.robots.settle import SETTLED, settled
from simgap.robots.whiten import Covariances, Whitener, covariances

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


def search(ask: Asked, tell: Progress, kept: Kept = NOWHERE, begin: Step | None = None) -> Found:
    """Search until the best set stays: where there are many windows in some of them first, from which all are
    gone on with. `begin`: a set to go on from, found in some of the windows."""
    few = ask.few
    start = Step(ask.plain.point) if begin is None else begin
    if not ask.forced and few is not ask:

        def ended() -> Step:
            last = _searched(few, start, tell, kept.of("some windows"))[1]
            there = settled(ask.composed, last.point, ask.factor, begin=last.off)
            return Step(there.point, last.best, field=last.field, whole=False, off=there.discrepancy)

        start, ask = kept("some windows", ended), replace(ask, last=True)
    return _searched(ask, start, tell, kept)[0]


def exchanged(ask: Asked, point: Point, held: Sequence[str]) -> Step | None:
    """What to go on from once held-out logs have taken effects out of a set: with others in the place of one
    of those that are left, if that is better."""
    return _exchanged(_Place.of(ask.few, point, held, ask.candidates), ask.candidates)


def _searched(ask: Asked, step: Step, tell: Progress, kept: Kept) -> tuple[Found, Step]:
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


def _round(ask: Asked, step: Step, number: int) -> tuple[Found, Step]:
    """One round: the sets that promise most about the step's point, and where the first that keeps what it
    promised settles."""
    asked = ask.asked(step, number)
    place = _Place.of(ask, step.point, ask.forced or step.best, asked, step.off)
    found = place.found()
    if not {*place.held} <= {*step.point}:
        there = place.settled(place.here)
        return found, Step(there.point, place.held, off=there.discrepancy)
    if not ask.forced and number < ROUNDS - 1:
        better = _better(place, place) or _exchanged(place, asked)
        if better is not None:
            return found, better
    # Whatever a set has gained or lost changes what comes near beside it.
    if len(asked) < len(ask.candidates):
        return found, replace(step, whole=True)
    field = {*place.names, *nearest(place.every, place.held)[:LEADERS]}
    return found, replace(step, ended=True, field=tuple(sorted(field)))


def _better(place: _Place, now: _Place) -> Step | None:
    """A set that promises more than the place's own, and that scores better than what is held now where it
    settles.

    What comes one by one is judged again when the search has ended, and held-out logs need only be for it
    sooner than against it. Two at once, or others in the place of one, they must bear out: where the model is
    off by itself there are many such sets.
    """
    tried: set[tuple[str, ...]] = {place.held}
    for proposals in ((one_more,), (two_more,)) if place is now else ((one_more, two_more),):
        sets = set().union(*map(place.proposed, proposals))
        promising = sorted(map(place.judge, sorted(sets - tried)), key=lambda one: -one.score)
        for one in [p for p in promising if p.score > place.here.score + SETTLED][:TRIED]:
            say(f"trying {' + '.join(one.names) or 'nothing'}")
            there = place.settled(one)
            score, held_out = place.tried(there, one.names)
            most = EVEN if place is now and one_more in proposals else BORNE_OUT
            if score > now.here.score + SETTLED and chance_of(held_out - now.held_out) < most:
                return Step(there.point, one.names, off=there.discrepancy)
        tried |= sets
        if not place.here.discrepancy:  # nothing is left for what helps only together
            break
    return None


def _exchanged(place: _Place, asked: Sequence[str]) -> Step | None:
    """A set with others in the place of one effect, if that is better: sought about the point without it, for
    what it does to the model changes what others seem to do. What is small is not told where something is
    left, whatever is in its place."""
    ask = place.ask
    if ask.last or not place.here.discrepancy:
        return None
    for out in place.large:
        rest = tuple(n for n in place.held if n != out)
        left = {n: values for n, values in place.linear.point.items() if n != out}
        there = settled(ask.composed, left, ask.factor, begin=place.here.discrepancy)
        others = [n for n in asked if n != out]
        better = _better(_Place.of(ask, there.point, rest, others, there.discrepancy), place)
        if better is not None:
            return better
    return None


@dataclass(frozen=True)
class _Place:
    """A set where it has settled, `held`, judged `here`, and the gap linear about there: by two `scales`,
    that of the discrepancy that is left and of the sensors' noise alone, `every` candidate, and the `names`
    of those that come near."""

    ask: Asked
    linear: Linear
    scales: tuple[Whitener, ...]
    every: tuple[Forms, ...]
    names: tuple[str, ...]
    held: tuple[str, ...]
    judge: Judge
    here: Judged

    @classmethod
    def of(
        cls, ask: Asked, point: Point, held: Sequence[str], asked: Sequence[str], begin: Discrepancy = NONE
    ) -> _Place:
        """About a point, with these candidates; `begin`: about what discrepancy is left there."""
        linear = ask.linearised(point, asked)
        usable = [n for n in asked if n in linear.moved]
        cov = covariances(ask.composed, linear, ask.factor)
        off = learned(cov, linear.residual, begin=begin)
        # What a cause does is hidden by the discrepancy that is left without it, and what is none of the
        # causes' doing misleads without one: what comes near by either is asked.
        scales = tuple(cov.whitener(d) for d in ((off, NONE) if off else (NONE,)))
        every = tuple(ask.forms(linear, whiten, usable) for whiten in scales)
        linear, names = leaders(ask.composed, linear, every, held, LEADERS)
        there = tuple(n for n in names if n in held)
        judge = Judge(ask.composed, ask.phases, linear, cov, off, every[0].log_odds)
        return cls(ask, linear, scales, every, tuple(names), there, judge, judge(there))

    @property
    def large(self) -> tuple[str, ...]:
        """Those of the set without which more comes back than an error in the largest one's form would be."""
        sensor, left = self.judge.covariances.whitener(), np.nan_to_num(self.linear.residual)
        shift = {n: np.nan_to_num(self.linear.moved[n].shift) for n in self.held}
        lost = {n: np.sum(sensor(left + rows) ** 2) - np.sum(sensor(left) ** 2) for n, rows in shift.items()}
        return tuple(n for n in self.held if lost[n] >= LEAST * max(lost.values()))

    def found(self) -> Found:
        """What is known there, the set the best."""
        f = self.ask.forms(self.linear, self.here.whiten, self.names)
        model = fitted(f, tuple(self.names.index(n) for n in self.held))
        cov, off = self.judge.covariances, self.here.discrepancy
        return Found(self.linear, self.here.whiten, cov, off, f, (model,), self.held)

    def proposed(self, propose: Callable[[Forms, Sequence[int]], list[Model]]) -> set[tuple[str, ...]]:
        """Other sets that promise most, by each scale."""
        own, found = [self.names.index(n) for n in self.held], set()
        for whiten in self.scales:
            models = propose(self.ask.forms(self.linear, whiten, self.names), own)[:PROPOSED]
            found |= {tuple(self.names[j] for j in m.effects) for m in models}
        return found

    def settled(self, one: Judged) -> Fit:
        """Where a set settles that was judged here."""
        f = self.ask.forms(self.linear, one.whiten, one.names)
        begin = point_of(self.ask.composed, f, tuple(range(len(one.names))), self.linear.point)
        first = reached(self.ask.composed, self.linear, one.whiten, begin)
        return settled(self.ask.composed, first, self.ask.factor, begin=one.discrepancy)

    @cached_property
    def held_out(self) -> np.ndarray:
        """Log likelihood of each fold's rows (folds,), fitted to the others."""
        return self._held_out(self.linear, self.here)

    def tried(self, there: Fit, names: tuple[str, ...]) -> tuple[float, np.ndarray]:
        """Of a set where it has settled its score, minus infinity where the simulator diverges more than it
        did, and its log likelihood of each fold's rows (folds,)."""
        ask = self.ask
        linear = linearise(ask.composed, there.point, [*fitted_along(ask.composed), *names])
        if linear.dropped > self.linear.dropped or linear.diverged:
            return -np.inf, np.zeros(np.unique(ask.fold).size)
        cov = covariances(ask.composed, linear, ask.factor)
        off = learned(cov, linear.residual, begin=there.discrepancy)
        one = Judge(ask.composed, ask.phases, linear, cov, off, self.judge.log_odds)(names)
        return one.score, self._held_out(linear, one)

    def _held_out(self, linear: Linear, one: Judged) -> np.ndarray:
        f, fold = self.ask.forms(linear, one.whiten, one.names), self.ask.fold
        every = tuple(range(len(one.names)))
        score = held_out_scores(f.gap, [every], fold[np.isfinite(linear.residual)])[:, 0]
        return score - one.whiten.half_log_dets(np.unique(fold, return_inverse=True)[1])
