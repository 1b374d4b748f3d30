"""The search for the effects that act: proposals in closed form about a point, then exact fits.

About the point of the best set so far every candidate is rolled out once. Sets near it (one effect more, one
less, one exchanged, two more) are ranked by their evidence in closed form, and the leading ones are fitted
exactly, each with the discrepancy that it leaves. When none is better, every cause is taken out in turn, and
replacements are proposed about the point without it, because a straight line from where one hysteresis acts
to where another would act says nothing of either. All sets that were fitted exactly on the way make the
posterior over sets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import gammaln
from scipy.stats import t as student

from simgap.attribution.verdict import RULED_OUT
from simgap.latest import latest
from simgap.progress import Progress, say, silent
from simgap.robots.calibrate import Calibration
from simgap.robots.fit import HALVINGS, fit_effects, prior_cost
from simgap.robots.linear import Base, Linear, Moved, base_at, linearise, rows_at, vary, with_wobble
from simgap.robots.model import Composed, Point
from simgap.robots.sets import (
    Identifiability,
    Names,
    Sets,
    identifiability,
    neighbours,
    pairs,
    point_of,
    without,
)
from simgap.robots.whiten import ALONE, NONE, Covariances, Discrepancy, Whitener, covariances
from simgap.robots.windows import JUMPS, STRIKES

EXPECTED = 1.0  # prior: how many of all candidates act
LEVELS = (1.0, 0.3, 0.1, 0.03)  # numerics: shares of the discrepancy with which sets are scored
TRIED = 4  # numerics: sets that are fitted exactly about one point
LEARNED = 2  # numerics: of these, how many show by how much straight lines promise too much
LEADERS = (16, 4)  # numerics: candidates that are rolled out where they fit best, and that once more
FIRST_LEADERS = (16, 8, 4, 4)  # numerics: the same where nothing acts yet
NOTHING_NEW = 0.1  # numerics: usual sizes; a candidate is rolled out no nearer to where it was before
USUAL = 1.0  # numerics: usual sizes by which a candidate that does not act yet is varied
LEAVES = 2.0  # numerics: squares over the noise's from which a search from the calibration follows
SMALL = 0.01  # numerics: usual sizes; what calibration moved by less stays
NEAR = 10.0  # numerics: nats by which a proposal of a replacement may be wrong
REPLACES = 0.5  # chosen: share of what a cause explains that lines have a replacement explain at least
FAR = 30.0  # numerics: usual sizes to which a straight line is trusted
BETTER = 2.0  # numerics: nats by which a set must be better for the search to go on from it
SETTLED = 0.3  # numerics: nats to which the leading sets are fitted in the end, as three rule one out
NEAR_BY = 20.0  # numerics: nats of the best set within which others are fitted to the end
AGAIN = 4  # numerics: fits of a set, each whitened by what the last one left
ROUNDS = 12  # numerics: most steps of a search
BY_CHANCE = 0.05  # chosen: of sets that predict held-out folds no better, the share that may be said to


@dataclass(frozen=True, eq=False)
class FittedSet:
    """A set of effects at its best fit.

    `composed`: the model, with the derivatives by the simulator's own numbers taken at the fit; `names`: the
    set; `point`: its parameters, and those of what is fitted along; `linear`: the gap linearised about the
    point, in the set's effects; `covariances`: of the rows; `discrepancy`: what the set leaves beyond noise;
    `wide`: windows that are off for reasons of their own, with the factor of their variance; `whiten`: by
    noise, discrepancy and wide windows; `sets`: the closed form about the point; `score`: log evidence
    [nats]; `promise`: log evidence [nats] that the closed form expects of a further step.
    """

    composed: Composed
    names: Names
    point: Point
    linear: Linear
    covariances: Covariances
    discrepancy: Discrepancy
    wide: dict[int, float]
    whiten: Whitener
    sets: Sets
    score: float
    promise: float

    @cached_property
    def squares(self) -> np.ndarray:
        """Squares (N,) of the residual, whitened by the sensors' noise and the uncertain starts alone."""
        return self.covariances.whitener()(np.nan_to_num(self.linear.residual)) ** 2

    @cached_property
    def fine(self) -> np.ndarray:
        """Rows (N,) of windows that neither diverged nor are off for reasons of their own."""
        return np.isfinite(self.linear.residual) & ~np.isin(self.linear.rows.window, list(self.wide))

    def less(self, out: str) -> Names:
        """The set without one effect."""
        return tuple(n for n in self.names if n != out)

    def promises(self, names: Names) -> float:
        """The score that the closed form expects of a smaller set next to this one; none where an effect
        diverges."""
        if not {*self.names} <= {*self.sets.names}:
            return -np.inf
        whole, part = (float(self.sets.scores([one], 0)[0]) for one in (self.names, names))
        return self.score + part - whole

    @cached_property
    def noise(self) -> float:
        """The expected mean square of a row under noise alone."""
        return self.covariances.floor() / max(int(np.isfinite(self.linear.residual).sum()), 1)


@dataclass
class Search:
    """A search over sets of candidates.

    `composed`: the model along the windows that are compared; `wanted`: names of the candidates; `fold`: fold
    (N,) of each row; `calibrated`: fits what nobody measured, from the model as it comes; called where a gap
    is left; `calibration`: its result; `fitted`: all fitted sets, each at its best; `columns`: candidates as
    they were rolled out where the search began; None of one that diverged; `identifiable`: which candidates'
    parameters the logs tell apart; `diverged`: candidates that diverge.
    """

    composed: Composed
    wanted: Names
    fold: np.ndarray
    calibrated: Callable[[], Calibration | None] = lambda: None
    calibration: Calibration | None = None
    fitted: dict[frozenset[str], FittedSet] = field(default_factory=dict)
    columns: dict[str, Moved | None] = field(default_factory=dict)
    identifiable: Identifiability = field(default_factory=lambda: Identifiability((), ()))
    diverged: tuple[str, ...] = ()
    _proposed: dict[Any, Any] = field(default_factory=dict, repr=False)
    _densities: dict[tuple[FittedSet, FittedSet], np.ndarray] = field(default_factory=dict, repr=False)

    @cached_property
    def along(self) -> Names:
        """Effects that are fitted along with every set."""
        return tuple(n for n, e in self.composed.effects.items() if e.fitted)

    @property
    def log_odds(self) -> float:
        """Prior log odds of one candidate to act."""
        share = min(EXPECTED / max(len(self.wanted), 1), 0.5)
        return float(np.log(share / (1 - share)))

    def run(self, tell: Progress, note: Progress = silent) -> FittedSet:
        """The best set, searched forwards from nothing and, where that leaves a gap, backwards from the
        calibration; `note`: told at once where the gap is and how large."""
        best = self._from(self.nothing(note), tell)
        if best.squares[best.fine].mean() > LEAVES * best.noise:
            tell("from the calibration")
            self.columns.clear()
            other = self._from_calibration()
            if other is not None and self._is_better(other, best):
                best = self._from(other, tell)
        return self._settled(best)

    def _settled(self, best: FittedSet) -> FittedSet:
        """The best set, and those that may be no worse, fitted to the end: three nats rule others out."""
        near = (s for s in self.fitted.values() if s.promise > best.score - np.log(RULED_OUT))
        for one in sorted(near, key=lambda one: -one.promise):
            if one.promise > one.score + SETTLED:
                self.fit(one.names, one.point, [one.whiten], -np.inf, one)
        best = self.fitted[frozenset(best.names)]
        leading = max(self.fitted.values(), key=lambda one: one.score)
        return self._with_less(leading) if self._is_better(leading, best) else best

    def forced(self, names: Names) -> FittedSet:
        """A given set at its best."""
        sets, levels = self.propose(self.nothing(), self.wanted)
        _, level, begin = self._likeliest(sets, names)
        return self._with_less(self.fit(names, begin, [levels[level]]))

    def _with_less(self, found: FittedSet) -> FittedSet:
        """A set, after all sets with one effect less are fitted, too: they judge what each effect takes."""
        for out in found.names if len(found.names) > 1 else ():
            self._without(found, out)
        return found

    def _without(self, found: FittedSet, out: str) -> FittedSet:
        """A set less one effect, fitted from the set's own point and starts unless that promises no more than
        is known: the solver's numbers have optima of their own, and sets are compared at the same."""
        rest = found.less(out)
        known = self.fitted.get(frozenset(rest))
        if known is not None and found.promises(rest) <= known.score + BETTER:
            return known
        return self.fit(rest, without(found.point, out), [found.whiten], near=found)

    def nothing(self, note: Progress = silent) -> FittedSet:
        """The empty set: only what is fitted along; `note`: as in `run`."""
        point: Point = {n: self.composed.effects[n].neutral() for n in self.along}
        linear = linearise(self.composed.moved(point), point, self.along)
        whiten = covariances(self.composed, linear).whitener()
        note(self._describe_gap(linear, whiten))
        if any(w.regime == STRIKES for w in self.composed.windows):
            every = self._rolled_out(self.composed, base_at(self.composed, point), self.wanted)
            self.composed = with_wobble(self.composed, linear.with_moved(every))
        return self.fit((), point, [whiten])

    def _describe_gap(self, linear: Linear, whiten: Whitener) -> str:
        """Where the gap of the model as it came is and how large, with what is fitted along at its best along
        straight lines."""
        effects, left = self.composed.effects, np.nan_to_num(linear.residual)
        at = point_of(effects, self._sets(linear, [whiten], ()).fit((), 0), (), self.along)
        for name, theta in at.items():
            moved = linear.moved[name]
            left = left - np.nan_to_num(moved.jacobian) @ (np.array([*theta.values()]) - moved.at)
        rms = linear.rows.rms(whiten(left), np.isfinite(linear.residual))
        each = ", ".join(f"{n} {v:.3g}" for n, v in sorted(rms.items(), key=lambda one: -one[1]))
        return f"the model as it came misses, in times the noise: {each}"

    def _from(self, best: FittedSet, tell: Progress) -> FittedSet:
        """The best set that steps lead to."""
        for number in range(ROUNDS):
            tell(f"round {number + 1}: {' + '.join(best.names) or 'nothing'}")
            at = best if best.names or not best.discrepancy else self._from_better_end(best)
            better = self._find_better(at, at)
            if better is None or not self._is_better(better, best):
                better = self._exchange(best)
            if better is None:
                break
            if not best.names:  # the solver's numbers have optima of their own: compare at the same
                point = {n: better.point[n] for n in self.along}
                anew = self.fit((), point, [better.whiten], near=better)
                if not self._is_better(better, anew):
                    best = anew
                    continue
            best = better
        return best

    def _from_better_end(self, nothing: FittedSet) -> FittedSet:
        """The empty set at that end of how the simulator takes its commands from which candidates promise
        more.

        Commands held in steps are nearly commands in lines that come later, and no small step leads from one
        to the other: what passes for a delay there hides what acts.
        """
        ends, promised = [nothing], []
        for name in (n for n in self.along if self.composed.effects[n].numeric):
            for short, p in self.composed.effects[name].parameters.items():
                if self.composed.effects[name].dear or p.nominal not in (p.low, p.high):
                    continue
                other = p.high if nothing.point[name][short] < 0.5 * (p.low + p.high) else p.low
                point = {**nothing.point, name: {**nothing.point[name], short: other}}
                composed = nothing.composed.moved(point)
                linear = linearise(composed, point, self.along, nothing.linear.starts)
                if not linear.diverged:
                    cov = covariances(composed, linear)
                    end = replace(nothing, composed=composed, point=point, linear=linear, covariances=cov)
                    ends.append(end)
        for end in ends:  # candidates act at all ends much as where they were rolled out first
            sets, levels, _ = self._columns_at(end, self.wanted)
            every = [(), *neighbours((), sets.names)]
            promised.append(max(float(sets.scores(every, k).max()) for k in range(len(levels))))
        return ends[int(np.argmax(promised))]

    def _from_calibration(self) -> FittedSet | None:
        """The set of what calibration moved, less what it can do without in closed form."""
        self.calibration = self.calibrated()
        calibrated = {} if self.calibration is None else self.calibration.point
        moved = {n: v for n, v in calibrated.items() if n in self.wanted and self._is_moved(n, v)}
        if not moved:
            return None
        names = tuple(moved)
        begin = {n: calibrated.get(n, self.composed.effects[n].neutral()) for n in self.along} | moved
        whole = self.fit(names, begin, [self.fitted[frozenset()].covariances.whitener()])
        if whole.linear.diverged:
            return None
        sets, _ = self.propose(whole, names)
        names = sets.pruned(names, self._likeliest(sets, names)[1])
        return self.fit(names, self._likeliest(sets, names)[2], [whole.whiten])

    def _is_moved(self, name: str, values: Mapping[str, float]) -> bool:
        parameters = self.composed.effects[name].parameters
        return any(abs(parameters[n].coordinate(v)) > SMALL for n, v in values.items())

    def _likeliest(self, sets: Sets, names: Names) -> tuple[float, int, Point]:
        """A set's highest score in closed form, the level that gives it, and the point there."""
        score, level = max((float(sets.scores([names], k)[0]), k) for k in range(len(sets.gram)))
        return score, level, point_of(self.composed.effects, sets.fit(names, level), names, self.along)

    def fit(
        self, names: Names, begin: Point, scales: Sequence[Whitener], rival: float = -np.inf,
        near: FittedSet | None = None,
    ) -> FittedSet:  # fmt: skip
        """Fit a set exactly, and remember it at its best.

        Args:
            names: The set.
            begin: Where the fit begins.
            scales: Whiteners of the first fit. Later fits are whitened by what the set leaves itself, and run
                from where it puts the starts, as long as the closed form promises more, or is wrong along the
                starts of a leading set. A fit that stays behind the rival is begun anew with the next scale.
            rival: Log evidence [nats] of the set to beat.
            near: The set that it was proposed about: windows are run from its starts in the first fit, which
                goes back towards its point from a beginning that is worse.
        """
        say(f"fitting {' + '.join(names) or 'nothing'}")
        begin = begin if near is None else self._begun_on_samples(begin, scales, near)
        best, key, starts = None, frozenset(names), {} if near is None else near.linear.starts
        here = (self.composed if near is None else near.composed).moved(begin)
        known = begin if near is None else {n: near.point[n] for n in begin if n in near.point}
        nearby = linearise(here, known, [], starts)
        for whiten in scales:
            point = fit_effects(here, nearby, whiten, begin)
            one = self._judge(here, names, point)
            for _ in range(AGAIN):
                leading = max((one, *self.fitted.values()), key=lambda known: known.score)
                before, (there, linear, bend) = one.score, self._begun_anew(one, leading)
                bent = bend > BETTER and before + bend > leading.score - NEAR_BY
                # Sets differ by BETTER, so each is fitted to half of that.
                if not bent and one.promise < max(before + 0.5 * BETTER, rival - NEAR):
                    break
                again = self._judge(there, names, fit_effects(there, linear, one.whiten, one.point))
                one = max((one, again), key=lambda fitted: fitted.score)
                if one.score < before + BETTER:
                    break
            best = one if best is None or one.score > best.score else best
            if best.score >= rival - NEAR:
                break
        assert best is not None
        if key not in self.fitted or self.fitted[key].score < best.score:
            self.fitted[key] = best
        return self.fitted[key]

    def _begun_on_samples(self, begin: Point, scales: Sequence[Whitener], near: FittedSet) -> Point:
        """The beginning of a fit, or that with times of commands at whole samples and what is fitted along as
        it was, if that is closer to the logs.

        Forces of stiff servos jump with their commands, so lateness has an optimum at every sample, and
        straight lines lead beside it.
        """
        step, whole = float(np.median(np.diff(self.composed.recordings[0].t))), dict(begin)
        for name, theta in begin.items():
            effect = self.composed.effects[name]
            timed = [n for n, p in effect.parameters.items() if effect.command is not None and p.unit == "s"]
            whole[name] = {**theta, **{n: step * round(theta[n] / step) for n in timed}}
        if whole == begin:
            return begin

        def closeness(point: Point) -> float:
            rows = base_at(near.composed.moved(point), point).rows
            return _best_level(scales, near.linear.target - rows) if np.isfinite(rows).any() else -np.inf

        return max(begin, whole | {n: near.point[n] for n in self.along}, key=closeness)

    def _begun_anew(self, one: FittedSet, leading: FittedSet) -> tuple[Composed, Linear, float]:
        """The model with windows run from where a set's fit puts their starts, the gap there, and by how much
        straight lines from where they were run from are wrong there [nats].

        The judge is what the leading set leaves: what lines are wrong by passes for a set's own discrepancy.
        """
        composed, linear, asides = one.composed, one.linear, {}
        for k, sizes in one.covariances.starts(one.whiten, np.nan_to_num(linear.residual)).items():
            away = zip(composed.windows[k].doubt.items(), sizes, strict=True)
            asides[k] = {n: float(doubt * size) for (n, doubt), size in away if n != JUMPS}
        if not any(asides.values()):
            return composed.moved(one.point), linear, 0.0
        there = composed.run_aside(asides)
        anew = linearise(there, one.point, [], linear.starts)
        judge = one.covariances.whitener(leading.discrepancy, leading.wide)
        off = judge(np.nan_to_num(anew.residual - linear.residual))
        return there.moved(one.point), anew, 0.5 * float(np.sum(off**2))

    def _judge(self, composed: Composed, names: Names, point: Point) -> FittedSet:
        """A set at its fitted point, with its discrepancy and its log evidence (Laplace's).

        Friction damps the errors of starts, so that their sensitivities are a set's own: with another's,
        something always seems to be left.
        """
        linear = linearise(composed, point, [*self.along, *names])
        cov = covariances(composed, linear)
        left = np.nan_to_num(linear.residual)
        discrepancy = cov.estimate(left)
        whiten = cov.whitener(discrepancy)
        if wide := cov.outliers(whiten, left):
            discrepancy = cov.estimate(left, wide, discrepancy)
            whiten = cov.whitener(discrepancy, wide)
        sets = self._sets(linear, [whiten], names)
        score = promise = -np.inf
        if not linear.diverged:
            white = whiten(left)
            fit = sets.fit(names, 0)
            promise = fit.score + len(wide) * ALONE - 1e3 * linear.dropped
            loose = np.diag(fit.covariance)[len(fit.x) - sum(sets.size) :] > 0
            score = -0.5 * float(white @ white) - whiten.half_log_det - prior_cost(composed, point)
            score += 0.5 * loose.sum() * np.log(2 * np.pi) + len(names) * self.log_odds
            inside = np.diag(fit.covariance) > 0
            score += 0.5 * float(np.linalg.slogdet(fit.covariance[np.ix_(inside, inside)])[1])
            score += _prior_constants(sets.size)
            score += len(wide) * ALONE - 1e3 * linear.dropped
        return FittedSet(composed, names, point, linear, cov, discrepancy, wide, whiten, sets, float(score),
                         float(promise))  # fmt: skip

    def _sets(self, linear: Linear, levels: Sequence[Whitener], names: Sequence[str]) -> Sets:
        """The closed form for those of some candidates that did not diverge."""
        usable = [n for n in names if n in linear.moved]
        return Sets.of(self.composed.effects, linear, levels, usable, self.fold, self.log_odds)

    def propose(self, at: FittedSet, names: Sequence[str]) -> tuple[Sets, list[Whitener]]:
        """Candidates about the point of a set, in closed form with its discrepancy and with less of it.

        Candidates that do not act yet are varied by their usual size, for a joint that sticks follows no
        small change. They stay as they were where the search began; the leading ones are rolled out anew.
        """
        composed, held = at.composed, at.names
        sets, levels, linear = self._columns_at(at, names)
        if not held and {*self.wanted} <= {*names}:
            self.identifiable = identifiability(*sets.product())
            self.diverged = tuple(n for n in names if n not in linear.moved)
        base = base_at(composed, at.point)
        # Where the gap is large, one straight line leads only part of the way; it is largest without causes.
        for count in LEADERS if held else FIRST_LEADERS:
            linear = self._roll_out_leaders(composed, base, linear, sets, levels, held, count)
            sets = self._sets(linear, levels, names)
        return sets, levels

    def _columns_at(self, at: FittedSet, names: Sequence[str]) -> tuple[Sets, list[Whitener], Linear]:
        """Candidates along straight lines about the point of a set: in closed form, its levels of the
        discrepancy, and the linearised gap."""
        others, base = [n for n in names if n not in at.names], base_at(at.composed, at.point)
        linear = at.linear.with_moved(self._rolled_out(at.composed, base, others))
        scales = [{n: s * k for n, s in at.discrepancy.items()} for k in LEVELS if at.discrepancy]
        levels = [at.covariances.whitener(d, at.wide) for d in (*scales, NONE)]
        return self._sets(linear, levels, names), levels, linear

    def _rolled_out(self, composed: Composed, base: Base, names: Sequence[str]) -> dict[str, Moved]:
        """Candidates that do not diverge, rolled out by their usual size where they were not before."""
        for name in names:
            if name not in self.columns:
                say(f"what {name} would do")
                size = np.full(len(composed.effects[name].parameters), USUAL)
                self.columns[name] = vary(composed, base, name, step=size)
        return {n: one for n in names if (one := self.columns[n]) is not None}

    def _roll_out_leaders(
        self, composed: Composed, base: Base, linear: Linear, sets: Sets, levels: Sequence[Whitener],
        held: Names, count: int,
    ) -> Linear:  # fmt: skip
        """The leading candidates rolled out where they fit best, or on the way there, where that is better
        than where they were rolled out before: what kinks or saturates is a straight line from there only."""
        effects, first = self.composed.effects, dict[str, dict[str, float]]()
        for level in dict.fromkeys((0, sets.gram.shape[0] - 1)):
            others = [n for n in sets.names if n not in held]
            score = sets.scores([(*held, n) for n in others], level)
            for name in (others[k] for k in np.argsort(-score)[:count]):
                if name not in first:
                    names = (*held, name)
                    found = point_of(effects, sets.fit(names, level), names, self.along)
                    first[name] = dict(found[name])
        more = dict[str, Moved]()
        for name, at in first.items():
            near = {}
            for (short, p), value in zip(effects[name].parameters.items(), at.values(), strict=True):
                near[short] = float(np.clip(value, p.nominal - FAR * p.sd, p.nominal + FAR * p.sd))
            known = effects[name].parameters
            if all(abs(near[n] - p.nominal) < 1e-3 * p.sd for n, p in known.items()):
                near = {
                    n: p.nominal + (p.sd if p.nominal + p.sd <= p.high else -p.sd) for n, p in known.items()
                }
            before = linear.moved[name]
            away = [abs(near[n] - v) / p.sd for (n, p), v in zip(known.items(), before.at, strict=True)]
            if max(away) < NOTHING_NEW:
                continue
            most, found = _best_level(levels, linear.residual - before.shift), None
            for _ in range(HALVINGS):
                there = _best_level(levels, linear.target - rows_at(composed, base, name, near))
                if found is not None and there <= most:
                    break
                most, found = (there, near) if there > most else (most, found)
                near = {n: 0.5 * (near[n] + float(v)) for n, v in zip(known, before.at, strict=True)}
            one = None if found is None else vary(composed, base, name, found)
            more |= {} if one is None else {name: one}
        return linear.with_moved(more)

    def _find_better(self, at: FittedSet, best: FittedSet) -> FittedSet | None:
        """A set that beats the best after an exact fit, proposed about the point of `at`.

        `at` is the best itself, or the best less one cause, whose replacements are then sought.
        """
        names = self.wanted if at is best else self._rivals(at, best)
        sets, levels = latest(self._proposed, (at, names), lambda: self.propose(at, names), 2)
        near = neighbours(at.names, sets.names)
        near += [sets.pruned(at.names, 0)] if len(at.names) > 1 else []
        singles = len(near)
        near += pairs(at.names, sets.names) if at is best or not at.names else []  # a replacement is single
        score = np.stack([sets.scores(near, level) for level in range(len(levels))])
        own = max(sets.scores([at.names], level)[0] for level in range(len(levels)))
        level = [int(k) for k in score.argmax(0)]
        promised = score.max(0) - own + at.score - best.score
        least = BETTER
        if at is not best:  # straight lines miss as much of a replacement as they miss of the best itself
            of_best = score.max(0)[[{*names} == {*best.names} for names in near]]
            least = min(0.0, *(of_best - own + at.score - best.score)) - NEAR
        tolerated = -_unsure(best.score - at.score)
        found, order, learned, wrong = best, np.argsort(-promised), 0, -np.inf
        # Of a large gap lines promise too little of one effect and too much of two: one alone is tried first.
        for part in (order,) if at.names else (order[order < singles], order[order >= singles]):
            if found is not best:
                least = max(least, found.score - best.score + NEAR)
            tried = 0
            for k in part:
                # Two replacements are fitted to the end even so, if lines have them replace enough: these may
                # miss by more.
                learns = at is not best and learned < LEARNED and promised[k] > tolerated
                if tried >= TRIED or (promised[k] < least and not learns):
                    break
                names = near[k]
                begin = point_of(self.composed.effects, sets.fit(names, level[k]), names, self.along)
                if frozenset(names) in self.fitted or (at is not best and {*best.names} < {*names}):
                    continue
                scales = [levels[i] for i in dict.fromkeys((level[k], len(levels) - 1))]
                one = self.fit(names, begin, scales, -np.inf if learns else best.score, at)
                tried, learned = tried + 1, learned + 1
                wrong = max(wrong, one.score - best.score - promised[k])
                if one.score > found.score and self._is_better(one, best):
                    found = one
                    # Others are better proposed about it, if what it leaves is not that of a wrong first.
                    if at is best and one.score > best.score + NEAR and (at.names or not one.discrepancy):
                        break
                if learned >= LEARNED:  # other promises are wrong by as much as these were
                    least = max(least, found.score - best.score - NEAR - wrong)
        return None if found is best else found

    def _rivals(self, less: FittedSet, best: FittedSet) -> Names:
        """Effects of the best set, and those that may do what it has and `less` lacks.

        Straight lines about the best have them make up for REPLACES of what is lost, or all but NEAR.
        """
        sets, levels = latest(self._proposed, (best, self.wanted), lambda: self.propose(best, self.wanted), 2)
        others, out = [n for n in sets.names if n not in best.names], {*best.names}
        tried = [best.names, less.names, *((*less.names, n) for n in others)]
        for level in range(len(levels)):
            own, lost, *left = sets.scores(tried, level)
            out |= {n for n, score in zip(others, left, strict=True) if own - score < _unsure(own - lost)}
        return tuple(n for n in self.wanted if n in out)

    def predicts_better(self, one: FittedSet, other: FittedSet, by: FittedSet) -> bool:
        """Whether a set predicts held-out folds better than another.

        Both have the discrepancy of `by`, one of them: its size differs between motions, so that a set which
        leaves a smaller one in some of them predicts the others no worse for it. How errors of starts grow is
        each set's own.
        """
        gain = self._held_out(one, by) - self._held_out(other, by)
        return predicts_better(gain, _overstated(by, other if one is by else one))

    def _held_out(self, one: FittedSet, by: FittedSet) -> np.ndarray:
        if (one, by) not in self._densities:
            whiten = one.covariances.whitener(by.discrepancy, by.wide)
            self._densities[one, by] = self._sets(one.linear, [whiten], one.names).held_out(one.names, 0)
        return self._densities[one, by]

    def _is_better(self, one: FittedSet, best: FittedSet) -> bool:
        """Whether to go on from a set: it is likelier and drops causes, or is as simple and predicts held-out
        logs no worse; or it is much likelier and predicts them better.

        The judge is what the likelier set leaves: next to a discrepancy of twenty times the noise, a cause
        that explains it all hardly shows.
        """
        if {*one.names} < {*best.names} or one.score <= best.score:
            return one.score > best.score
        if len(one.names) == len(best.names) and sum(one.sets.size) <= sum(best.sets.size):
            return not self.predicts_better(best, one, one)
        return one.score > best.score + BETTER and self.predicts_better(one, best, one)

    def _judge_twins(self, best: FittedSet, out: str) -> None:
        """Judge in a cause's place what does the same by the same share, as a command's gain does what its
        motor's does: where the gap is large, straight lines do not lead from nothing to both."""
        every = {n: [*self.composed.effects[n].parameters.items()] for n in (out, *self.wanted)}
        shares = {n: known[0] for n, known in every.items() if [p.unit for _, p in known] == ["1"]}
        for name, (short, p) in shares.items() if out in shares else ():
            if name in best.names:
                continue
            own, q = shares[out]
            at = {short: p.nominal + best.point[out][own] - q.nominal}
            point = {**without(best.point, out), name: at}
            apart = best.linear.target - best.linear.residual - base_at(best.composed, point).rows
            if np.sum(best.covariances.whitener()(apart) ** 2) < SETTLED:
                one = self._judge(best.composed, (*best.less(out), name), point)
                known = self.fitted.get(frozenset(one.names), one)
                self.fitted[frozenset(one.names)] = max(one, known, key=lambda fitted: fitted.score)

    def _exchange(self, best: FittedSet) -> FittedSet | None:
        """A better set without one of the best's causes, least needed first, or with replacements for one."""
        for out in sorted(best.names, key=lambda out: -best.promises(best.less(out))):
            self._judge_twins(best, out)
            less = self._without(best, out)
            if less.linear.diverged:  # nothing can be proposed about it
                continue
            there = less if self._is_better(less, best) else self._find_better(less, best)
            if there is not None:
                return there
        return None


def _unsure(lost: float) -> float:
    """Nats by which lines may have a replacement stay behind a cause without which `lost` nats are lost."""
    return max(NEAR, (1 - REPLACES) * lost)


def _best_level(levels: Sequence[Whitener], residual: np.ndarray) -> float:
    """Log density of a residual (N,) with the level of the discrepancy that gives the most [nats]."""
    left = np.nan_to_num(residual)
    return max(-0.5 * float(np.sum(whiten(left) ** 2)) - whiten.half_log_det for whiten in levels)


def _prior_constants(sizes: Sequence[int]) -> float:
    """Log normalising constants of the slabs, one multivariate Cauchy distribution of each size."""
    return float(sum(gammaln((1 + k) / 2) - gammaln(0.5) - 0.5 * k * np.log(np.pi) for k in sizes))


def _overstated(by: FittedSet, rival: FittedSet) -> float:
    """By how much the discrepancy of a set overstates log odds over a rival; 1 if by nothing.

    Where the score of a step from one to the other varies more between windows than its information says, log
    odds are that many times too large (Royall and Tsou, JRSS B 65, 2003).
    """
    if not by.discrepancy:
        return 1.0
    left = np.nan_to_num(by.linear.residual)
    apart = by.whiten(np.nan_to_num(rival.linear.residual) - left)
    varies = np.sum(np.bincount(by.linear.rows.window, apart * by.whiten(left)) ** 2)
    return max(float(varies) / max(float(apart @ apart), 1e-12), 1.0)


def predicts_better(gain: np.ndarray, overstated: float = 1.0) -> bool:
    """Whether a set predicts held-out folds better than a rival.

    Either the gains are consistent between folds (a one-sided t test), or the folds' odds say so: if the
    rival were right, ratios of predictive densities would have a mean of 1, and so exceed 20 in at most one
    of 20 cases (Markov's inequality). As densities are only as good as the discrepancy in them, these odds
    must hold without the fold that says the most, and no fold may have them against the set. The t test
    alone rules out next to nothing with two or three logs in some of which a cause hardly shows.

    In the t test gains beyond a nat count by their logarithm: one log in which a cause shows a hundred times
    as much as in the others must not make the others' agreement look like scatter.

    Args:
        gain: Gains (folds,) of log density [nats].
        overstated: By how much the discrepancy makes them too large.
    """
    odds = -np.log(BY_CHANCE) * overstated
    if gain.size < 2 or (gain.sum() - gain.max() > odds and gain.min() > -odds):
        return True
    return by_chance(np.arcsinh(gain)) < BY_CHANCE


def by_chance(gains: np.ndarray) -> float:
    """The p-value of gains (n,) if their mean is none: one-sided, by Student's t; 0.5 of a single one."""
    if gains.size < 2:
        return 0.5
    sd = max(float(gains.std(ddof=1)), 1e-12)
    return float(student.sf(gains.mean() / sd * np.sqrt(gains.size), gains.size - 1))
