"""Effects that could stand in for a named cause, each judged where it fits best.

A straight line from where one hysteresis acts to where another would is no measure of either: about the point
of a dead band, friction at its neutral value moves nothing. So what could take a cause's place is sought
about the point without that cause, fitted exactly, and linearised where it then is. It stands in where it
explains most of what the cause does, unless logs that took no part in a fit bear out that the cause is the
better of the two: where the model is off by itself, all rows together are no judge of small differences.

Hystereses have many best fits. One is found from where straight lines lead, and one from where the effect
does most nearly what the cause does: a play of no width is a best fit too, but it is not that one that the
logs may have in a dead band's place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.attribution.verdict import MOST, RULED_OUT
from simgap.robots.borne_out import BORNE_OUT, borne_out, chance_of, held_out_scores
from simgap.robots.discrepancy import learned
from simgap.robots.fit import moved_to, reached
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.linear import Linear, base_at, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.proposals import leaders, point_of, ranked
from simgap.robots.scatter import scattering
from simgap.robots.search import LEADERS, Found
from simgap.robots.settle import settled
from simgap.robots.whiten import Whitener, covariances

TRIED = 6  # numerics: effects that are tried in a cause's place


@dataclass(frozen=True)
class StandIn:
    """An effect in a cause's `place`: the gap where it acts, the set with it there, and what held-out logs
    `bear` out of that set."""

    name: str
    place: str
    forms: Forms
    model: Model
    bear: tuple[str, ...]


@dataclass(frozen=True)
class _Fit:
    """A set at its own best: where that is, the gap linear about it with the fold (n,) of its rows, its log
    likelihood by fold, and what it leaves: squares by the sensors' noise alone, less the noise's own."""

    point: Point
    forms: Forms
    model: Model
    fold: np.ndarray
    held_out: np.ndarray
    left: float


@dataclass(frozen=True)
class _Asked:
    """What sets are compared in: windows, the fold and the factor on the noise's sd of each row (N,), the
    whitening by the discrepancies that the causes themselves leave, and by the sensors' noise alone, and how
    many windows the simulator diverges in with the causes."""

    composed: Composed
    phases: Phases
    fold: np.ndarray
    factor: np.ndarray
    whiten: Whitener
    sensor: Whitener
    dropped: int

    def among(self, numbers: Sequence[int], point: Point) -> _Asked:
        """The same in some of the windows alone."""
        part, mine = self.composed.among(numbers), np.isin(self.composed.rows.window, numbers)
        factor = self.factor[mine]
        linear = linearise(part, point, [])
        cov = covariances(part, linear, factor)
        whiten = cov.whitener(learned(cov, linear.residual))
        return _Asked(part, self.phases, self.fold[mine], factor, whiten, cov.whitener(), linear.dropped)

    def fit(self, point: Point, causes: Sequence[str]) -> _Fit | None:
        """A set fitted exactly, from a point; None where the simulator diverges with it."""
        point = settled(self.composed, point, whiten=self.whiten).point
        linear = linearise(self.composed, point, [*fitted_along(self.composed), *causes])
        if linear.dropped > self.dropped or not {*causes} <= linear.moved.keys():
            return None
        f = forms(gap_of(self.composed, linear, self.whiten, self.phases, causes))
        every = tuple(range(len(causes)))
        rows = np.flatnonzero(np.isfinite(linear.residual))
        fold = self.fold[rows]
        score = held_out_scores(f.gap, [every], fold)[:, 0]
        left = float(np.sum(self.sensor(np.nan_to_num(linear.residual)) ** 2)) - rows.size
        return _Fit(point, f, fitted(f, every), fold, score, max(left, 0.0))

    def likely(self, point: Point, out: str, wanted: Sequence[str]) -> list[tuple[str, tuple[Point, ...]]]:
        """Effects that gain most in the place of one that acts at a point, `out`, or that do most nearly what
        it does, and from where each is to be fitted."""
        without = {n: values for n, values in point.items() if n != out}
        along = fitted_along(self.composed)
        here = [n for n in without if n not in along]
        linear = linearise(self.composed, without, [*along, *here, *wanted])
        usable = [n for n in (*here, *wanted) if n in linear.moved]
        every = forms(gap_of(self.composed, linear, self.whiten, self.phases, usable))
        linear, names = leaders(self.composed, linear, [every], here, LEADERS)
        place = _Place.of(self, point, linear)
        alike = {n: -place.led(n)[1] for n in usable if n not in here}
        names = sorted({*names, *sorted(alike, key=lambda n: -alike[n])[:TRIED]})
        f = forms(gap_of(self.composed, linear, self.whiten, self.phases, names))
        mine = [names.index(n) for n in here if n in names]
        sets = {n: tuple(sorted((*mine, j))) for j, n in enumerate(names) if n not in here}
        gains = {n: fitted(f, effects).score for n, effects in sets.items()}
        first = ranked([gains, {n: alike[n] for n in sets}])[:TRIED]
        led = {n: point_of(self.composed, f, sets[n], without) for n in first}
        return [(n, (place.nearest(n), reached(self.composed, linear, self.whiten, led[n]))) for n in first]


@dataclass(frozen=True)
class _Place:
    """A cause's place: its doing as if that were what was recorded, all else as it is, and the linear model
    without it."""

    composed: Composed
    linear: Linear
    sensor: Whitener

    @classmethod
    def of(cls, asked: _Asked, point: Point, linear: Linear) -> _Place:
        """Of the cause that acts at a point and not at the linear model's."""
        there = base_at(asked.composed, point).rows
        target = np.where(np.isfinite(there), there, linear.rows.observed)
        rows = replace(linear.rows, observed=target)
        left = np.nan_to_num(target - (linear.rows.observed - linear.residual))
        linear = replace(linear, rows=rows, residual=left)
        return cls(replace(asked.composed, rows=rows), linear, asked.sensor)

    def led(self, name: str) -> tuple[dict[str, float], float]:
        """Where straight lines have an effect do most nearly the same, and the squares that it leaves."""
        moved, known = self.linear.moved[name], self.composed.effects[name].parameters
        slope = self.sensor(np.nan_to_num(moved.jacobian))
        wanted = self.sensor(self.linear.residual - np.nan_to_num(moved.shift))
        step, *_ = np.linalg.lstsq(slope, wanted)
        values = np.clip(moved.at + step, [p.low for p in known.values()], [p.high for p in known.values()])
        left = wanted - slope @ (values - moved.at)
        return dict(zip(known, values.tolist(), strict=True)), float(left @ left)

    def nearest(self, name: str) -> Point:
        """The point at which an effect does most nearly the same."""
        begin = {**self.linear.point, name: self.led(name)[0]}
        return moved_to(self.composed, self.linear, self.sensor, begin, [name]).point


def stand_ins(
    composed: Composed,
    phases: Phases,
    ended: Found,
    wanted: Sequence[str],
    causes: Sequence[str],
    fold: np.ndarray,
    factor: np.ndarray,
) -> tuple[StandIn, ...]:
    """Effects that take the place of one of `causes` (of those that act where the search ended) and that
    held-out logs do not tell from it. `fold`, `factor` (N,): of each row.

    Most are told apart in some of the windows, and are asked no further.
    """
    point = ended.linear.point
    acting = [n for n in point if n not in fitted_along(composed)]
    others = [n for n in wanted if n not in acting]
    given = composed, phases, fold, factor, ended.whiten, ended.covariances.whitener(), ended.linear.dropped
    asked = [_Asked(*given)]
    few = composed.thinned()
    if len(few) < len(composed.windows) and np.unique(fold[np.isin(composed.rows.window, few)]).size > 2:
        asked.insert(0, asked[0].among(few, point))
    best = [one.fit(point, acting) for one in asked]
    found: list[StandIn] = []
    for out in causes:
        fewer = [n for n in acting if n != out]
        without = {n: values for n, values in point.items() if n != out}
        bare = [one.fit(without, fewer) for one in asked]
        for name, starts in asked[0].likely(point, out, others):
            for begin in starts:
                fit = _alike(asked, best, bare, begin, [*fewer, name])
                if fit is not None:
                    gap = fit.forms.gap
                    bear = borne_out(gap, range(len(acting)), fit.fold)
                    names = tuple(gap.candidates[j].name for j in bear)
                    model = scattering(fit.forms, fit.model, fit.fold)
                    found.append(StandIn(name, out, fit.forms, model, names))
                    break
    return tuple(found)


def _alike(
    asked: Sequence[_Asked],
    best: Sequence[_Fit | None],
    bare: Sequence[_Fit | None],
    begin: Point,
    causes: Sequence[str],
) -> _Fit | None:
    """Another set that no windows of `asked` tell from the `best` one, fitted from a start; `bare` is without
    the cause and what stands for it. None where some do."""
    fit = None
    for one, causing, lacking in zip(asked, best, bare, strict=True):
        fit = one.fit(begin, causes)
        if fit is None or causing is None or lacking is None or _told_apart(causing, fit, lacking):
            return None
        begin = fit.point
    return fit


def _told_apart(causing: _Fit, other: _Fit, lacking: _Fit) -> bool:
    """Whether another set is none of the answers; `lacking` is without the cause and what stands for it."""
    worse = other.left - causing.left
    if worse > MOST * (lacking.left - causing.left):
        return True
    # Sizes that are unusual tell against a set, and held-out logs may outweigh them.
    strange = log_prior(causing.forms, causing.model) - log_prior(other.forms, other.model)
    gain = causing.held_out - other.held_out
    if strange > np.log(RULED_OUT):
        return strange + float(gain.sum()) > float(np.log(RULED_OUT))
    return float(gain.sum()) > float(np.log(RULED_OUT)) and chance_of(gain) <= BORNE_OUT


def log_prior(f: Forms, model: Model) -> float:
    """Log prior of how far each effect of a set is from neutral at its mode, along the line to there.

    On a line a Cauchy prior (see `Candidate`) is one of a single parameter: a density of two is no measure of
    one."""
    each = [model.x[mine] for mine in coordinates(f, model.effects).values()]
    return -sum(float(np.log1p(x @ x)) for x in each)
