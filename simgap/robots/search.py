"""Which effects act: search about a point, move the point to what was found, and search again there.

Each round is exact at its point (all effects found so far at their values) and linear about it. Leaders are
rolled out at their own best fit, so that what kinks at its neutral value is seen where it acts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from simgap.attribution.posterior import Forms, Model, fitted, forms
from simgap.robots.discrepancy import learned
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.linear import Linear, base_at, linearise, vary
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.whiten import Covariances, Discrepancy, Whitener, covariances

ROUNDS = 10  # numerics: of an iteration that settles sooner
LEADERS = 24  # numerics: candidates that a search goes on with
STEPS = 8  # numerics: evaluations of a least-squares fit
SETTLED = 2.0  # chosen: nats that a further round must gain

Tell = Callable[[str], None]


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


def search(
    composed: Composed,
    phases: Phases,
    candidates: Sequence[str],
    tell: Tell,
    forced: Sequence[str] = (),
    factor: np.ndarray | None = None,
) -> Found:
    """Search until the best set and its parameters stay."""
    along = fitted_along(composed)
    point: Point = {n: composed.effects[n].neutral() for n in along}
    if along:
        rough = linearise(composed, point, along)
        for _ in range(2):
            cov = covariances(composed, rough, factor)
            point = moved_to(composed, rough, cov.whitener(learned(cov, rough.residual)), point)
            rough = linearise(composed, point, along)
    best: tuple[str, ...] = ()
    last, seen = None, set[tuple[str, ...]]()
    for number in range(ROUNDS):
        tell(f"round {number + 1}")
        linear = linearise(composed, point, [*along, *candidates])
        usable = [n for n in candidates if n in linear.moved]
        cov = covariances(composed, linear, factor)
        off = learned(cov, linear.residual)
        whiten = cov.whitener(off)
        linear, leaders = _leaders(composed, linear, whiten, phases, usable, best)
        f = forms(gap_of(composed, linear, whiten, phases, leaders))
        if forced:
            chosen = tuple(j for j, n in enumerate(leaders) if n in forced)
            models = [fitted(f, chosen), fitted(f, ())]
        else:
            models = [one_more(f, [leaders.index(n) for n in best if n in leaders])]
        now = tuple(sorted(leaders[j] for j in models[0].effects))
        last = Found(linear, whiten, cov, off, f, tuple(models), now)
        tell(f"round {number + 1}: {' + '.join(now) or 'nothing'}")
        settled = now == best and number and _gain(last) < SETTLED
        again = now != best and now in seen  # sets that take turns are alike, and none will win
        if settled or again or number == ROUNDS - 1:
            break
        seen.add(now)
        best = now
        point = moved_to(composed, linear, whiten, point_of(composed, f, models[0].effects, point))
    assert last is not None
    return last


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
    gap, model = f.gap, fitted(f, tuple(effects))
    out = {n: dict(point[n]) for n in fitted_along(composed)}
    at = gap.nuisance.shape[1]
    for j in model.effects:
        c = gap.candidates[j]
        values = np.clip(c.neutral + c.scale * model.x[at : at + c.at.size], c.low, c.high)
        out[c.name] = dict(zip(c.parameters, values.tolist(), strict=True))
        at += c.at.size
    return out


def _leaders(
    composed: Composed,
    linear: Linear,
    whiten: Whitener,
    phases: Phases,
    usable: list[str],
    best: tuple[str, ...],
) -> tuple[Linear, list[str]]:
    """The candidates that gain most beside the best set, rolled out at their own best fits."""
    held = [n for n in best if n in usable]
    f = forms(gap_of(composed, linear, whiten, phases, usable))
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
        begin = f.spectrum.num_nuisances + sum(f.gap.candidates[j].at.size for j in effects if j < own[name])
        values = np.clip(c.neutral + c.scale * model.x[begin : begin + c.at.size], c.low, c.high)
        # Straight lines are trusted to a few usual sizes only.
        values = np.clip(values, c.neutral - 5 * c.scale, c.neutral + 5 * c.scale)
        at[name] = dict(zip(c.parameters, values.tolist(), strict=True))
    first = sorted(gains, key=lambda n: -gains[n])[: max(LEADERS - len(held), 4)]
    base = base_at(composed, linear.point)
    more = {}
    for name in first:
        if all(
            abs(at[name][n] - p.nominal) < 1e-3 * p.sd for n, p in composed.effects[name].parameters.items()
        ):
            continue
        one = vary(composed, base, linear.starts, name, at[name])
        if one is not None:
            more[name] = one
    return linear.with_moved(more), sorted([*held, *first])


def moved_to(
    composed: Composed, linear: Linear, whiten: Whitener, point: Point, only: Sequence[str] | None = None
) -> Point:
    """The point of least squares of whitened residuals, from a start; priors as in attribution. `only`: the
    effects that are moved, all by default."""
    if only is not None and set(only) != set(point):
        held = {e: theta for e, theta in point.items() if e not in only}
        free = {e: theta for e, theta in point.items() if e in only}
        return {**point, **_moved(composed, linear, whiten, free, held)}
    return _moved(composed, linear, whiten, point, {})


def _moved(
    composed: Composed, linear: Linear, whiten: Whitener, point: Point, held: Point
) -> dict[str, Mapping[str, float]]:
    names = [(e, p) for e, theta in point.items() for p in theta]
    known = [composed.effects[e].parameters[p] for e, p in names]
    if not names:
        return dict(point)
    sd = np.array([p.sd for p in known])
    low, high = np.array([p.low for p in known]), np.array([p.high for p in known])
    nominal = np.array([p.nominal for p in known])
    loose = np.array([composed.effects[e].fitted for e, _ in names])

    def at(x: np.ndarray) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for (effect, short), value in zip(names, nominal + sd * x, strict=True):
            out.setdefault(effect, {})[short] = float(value)
        return out

    def prior(x: np.ndarray) -> np.ndarray:
        return np.where(loose, x, np.sqrt(2 * np.log1p(x**2)))

    def residual(x: np.ndarray) -> np.ndarray:
        found = linear.rows.observed - base_at(composed, {**held, **at(x)}).rows
        # A rollout that diverged is as far off as the recording is from its mean.
        found = np.where(np.isfinite(found), found, linear.rows.observed)
        return np.concatenate([whiten(np.where(np.isfinite(linear.residual), found, 0.0)), prior(x)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        here = at(x)
        base = base_at(composed, {**held, **here})
        columns = []
        for effect in here:
            moved = vary(composed, base, linear.starts, effect)
            size = len(composed.effects[effect].parameters)
            columns.append(np.zeros((linear.residual.size, size)) if moved is None else moved.jacobian)
        whole = np.concatenate(columns, 1) * sd
        slope = np.where(loose, 1.0, _slope(x))
        return np.concatenate([-whiten(np.where(np.isfinite(whole), whole, 0.0)), np.diag(slope)])

    order = [(e, p) for e in point for p in composed.effects[e].parameters]
    assert order == names, "a point names all parameters of its effects, in their order"
    begin = np.array([(point[e][p] - q.nominal) / q.sd for (e, p), q in zip(names, known, strict=True)])
    bounds = (low - nominal) / sd, (high - nominal) / sd
    inside = np.clip(begin, bounds[0] + 1e-6, bounds[1] - 1e-6)
    derivative: Any = jacobian
    done = least_squares(residual, inside, derivative, bounds=bounds, max_nfev=STEPS, method="trf", ftol=1e-5)
    return dict(at(np.clip(done.x, *bounds)))


def _slope(x: np.ndarray) -> np.ndarray:
    """Derivative of sqrt(2 log(1 + x^2)), which is sqrt(2) sign(x) near 0 (0 at 0)."""
    root = np.sqrt(2 * np.log1p(x**2))
    return np.where(root > 1e-9, 2 * x / (1 + x**2) / np.maximum(root, 1e-9), 0.0)
