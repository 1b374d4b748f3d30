"""How far the gap shrinks on stretches of logs that took no part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.heldout import fraction_gone
from simgap.attribution.posterior import forms
from simgap.attribution.search import sought
from simgap.robots.borne_out import EVEN, borne_out
from simgap.robots.fit import moved_to
from simgap.robots.linear import Linear, base_at, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.proposals import nearest, point_of
from simgap.robots.search import LEADERS, Found
from simgap.robots.settle import settled
from simgap.robots.whiten import Whitener, covariances


@dataclass(frozen=True)
class Shrinkage:
    """Mean squares of whitened residuals of held-out stretches `before` and `after` (noise's own: 1), and
    the gap's `fraction` that is gone with its 90 % interval by fold. `rms`: by channel before and after, in
    its unit; `found` by fold; `plain`, `residual` (N,): what both leave of the rows, and `squares` (2, N)
    of these whitened, NaN where one is not known."""

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]
    rms: dict[str, tuple[float, float]]
    found: tuple[tuple[str, ...], ...]
    plain: np.ndarray
    residual: np.ndarray
    squares: np.ndarray


def shrinkage(
    composed: Composed,
    found: Found,
    plain: Linear,
    sensor: Whitener,
    fold: np.ndarray,
    causes: Sequence[str],
    forced: bool = False,
) -> Shrinkage | None:
    """Nested: every fold is predicted by a search and a fit that saw the others alone, about the point where
    the search ended. To be told, a cause must be borne out; to predict by, it need only be the better bet.
    `plain`: the linear model where only what is fitted along is; `causes` are taken where they are `forced`.
    """
    rows, index = found.linear.rows, np.flatnonzero(np.isfinite(found.linear.residual))
    gap = found.forms.gap
    before, after = plain.residual.copy(), np.full(rows.log.size, np.nan)
    kept_sets = []
    whole_logs = all(np.unique(fold[rows.log == log]).size == 1 for log in np.unique(rows.log))
    for number in np.unique(fold):
        inside = fold == number
        seen = ~inside[index]
        train = forms(gap.taken(seen))
        if forced:
            kept = tuple(j for j, n in enumerate(found.names) if n in causes)
        else:
            near = {*nearest([train], found.best)[:LEADERS], *found.best}
            best = sought(train, among=[j for j, n in enumerate(found.names) if n in near])[0]
            kept = borne_out(gap.taken(seen), best.effects, fold[index][seen], EVEN)
        kept_sets.append(tuple(found.names[j] for j in kept))
        point = point_of(composed, train, kept, found.linear.point)
        if whole_logs:
            point = _refitted(composed, found, point, np.unique(rows.log[~inside]).tolist())
        logs = np.unique(rows.log[inside])
        part, mine = composed.along(logs.tolist()), np.isin(rows.log, logs)
        if whole_logs:
            point = _own(composed, found, point, logs.tolist())
            bare = _plain(composed, plain.point, np.unique(rows.log[~inside]).tolist())
            bare = _own(composed, found, bare, logs.tolist())
            before[mine] = rows.observed[mine] - base_at(part, bare).rows
        predicted = base_at(part, point).rows
        after[mine] = np.where(inside[mine], rows.observed[mine] - predicted, after[mine])
    return _measured(found.linear, before, after, sensor, fold, tuple(kept_sets))


def _plain(composed: Composed, point: Point, logs: Sequence[int]) -> Point:
    """What is fitted along, without any cause, by least squares on some logs: the least that it leaves."""
    if not point:
        return point
    part = composed.along(logs)
    linear = linearise(part, point, list(point))
    return moved_to(part, linear, covariances(part, linear).whitener(), point).point


def _measured(
    linear: Linear,
    before: np.ndarray,
    after: np.ndarray,
    sensor: Whitener,
    fold: np.ndarray,
    kept_sets: tuple[tuple[str, ...], ...],
) -> Shrinkage | None:
    usable = np.isfinite(after) & np.isfinite(before) & np.isfinite(linear.residual)
    numbers = np.unique(fold)
    white = [sensor(np.where(usable, r, 0.0)) ** 2 for r in (before, after)]
    square = np.array(
        [
            [float(np.sum(w[(fold == n) & usable])) for w in white] + [float(np.sum((fold == n) & usable))]
            for n in numbers
        ]
    )
    gone, there = square[:, 0] - square[:, 1], square[:, 0] - square[:, 2]
    if there.sum() <= 0:
        return None
    rms = {}
    for c, name in enumerate(linear.rows.channels):
        mine = usable & (linear.rows.channel == c)
        if mine.any():
            rms[name] = tuple(float(np.sqrt(np.mean(r[mine] ** 2))) for r in (before, after))
    total = square.sum(0)
    return Shrinkage(
        total[0] / total[2],
        total[1] / total[2],
        1.0,
        *fraction_gone(gone, there),
        rms,
        kept_sets,
        before,
        after,
        np.where(usable, white, np.nan),
    )


def _own(composed: Composed, found: Found, point: Point, logs: Sequence[int]) -> Point:
    """The point with what these logs have of their own fitted to them, for nothing else tells it."""
    by_log = [n for n in point if composed.effects[n].by_log]
    return _refitted(composed, found, point, logs, by_log) if by_log else point


def _refitted(
    composed: Composed, found: Found, point: Point, logs: Sequence[int], only: Sequence[str] | None = None
) -> Point:
    """The point fitted to some of the logs alone, exactly."""
    part = composed.along(logs)
    linear = linearise(part, found.linear.point, [])
    cov = covariances(part, linear)
    whiten = cov.whitener(found.discrepancy)
    there = moved_to(part, linear, whiten, point, only).point
    return there if only is not None else settled(part, there, whiten=whiten).point
