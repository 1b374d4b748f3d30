"""What logs that took no part say of a set: how far the gap shrinks on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.heldout import fraction_gone
from simgap.robots.fit import moved_to
from simgap.robots.linear import base_at, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.search import Settled
from simgap.robots.whiten import covariances


@dataclass(frozen=True)
class Shrinkage:
    """Mean squares of whitened residuals of held-out stretches `before` and `after` (noise's own:
    `noise_floor`), and the gap's `fraction` that is gone with its 90 % interval by fold.

    `rms`: by channel before and after, in its unit; `plain`, `residual` (N,): what both leave of the rows,
    and `squares` (2, N) of these whitened, NaN where one is not known.
    """

    before: float
    after: float
    noise_floor: float
    fraction: float
    interval_90: tuple[float, float]
    rms: dict[str, tuple[float, float]]
    plain: np.ndarray
    residual: np.ndarray
    squares: np.ndarray


def shrinkage(best: Settled, nothing: Settled, composed: Composed, fold: np.ndarray) -> Shrinkage | None:
    """Every fold predicted by the set fitted exactly to the others, and by what is fitted along alone; None
    where there is no gap to shrink. What each log has of its own is fitted to itself, for nothing else tells
    it."""
    rows = composed.rows
    before, after = np.full(rows.log.size, np.nan), np.full(rows.log.size, np.nan)
    for number in np.unique(fold):
        inside = fold == number
        windows = [np.unique(rows.window[m]).tolist() for m in (~inside, inside)]
        for one, left in ((nothing, before), (best, after)):
            train, test = (one.composed.among(w) for w in windows)
            point = _fitted(train, one, one.point)
            own = [n for n in point if composed.effects[n].by_log]
            point = _fitted(test, one, point, own) if own else point
            left[inside] = rows.observed[inside] - base_at(test, point).rows
    usable = np.isfinite(after) & np.isfinite(before) & ~np.isin(rows.window, list(best.wide))
    sensor = best.covariances.whitener()
    white = [sensor(np.where(usable, r, 0.0)) ** 2 for r in (before, after)]
    floor = best.noise
    square = np.array([[*(w[usable & (fold == n)].sum() for w in white), floor * np.sum(usable & (fold == n))]
                       for n in np.unique(fold)])  # fmt: skip
    gone, there = square[:, 0] - square[:, 1], square[:, 0] - square[:, 2]
    if there.sum() <= 0:
        return None
    was, now = rows.rms(before, usable), rows.rms(after, usable)
    rms = {name: (was[name], now[name]) for name in was}
    mean = square.sum(0) / usable.sum()
    fraction, interval = fraction_gone(gone, there)
    return Shrinkage(float(mean[0]), float(mean[1]), float(mean[2]), fraction, interval, rms, before, after,
                     np.where(usable, white, np.nan))  # fmt: skip


def _fitted(part: Composed, one: Settled, point: Point, only: Sequence[str] | None = None) -> Point:
    """The point fitted to some of the windows alone, by the discrepancy that all of them leave."""
    if not point:
        return point
    linear = linearise(part, point, [])
    return moved_to(part, linear, covariances(part, linear).whitener(one.discrepancy), point, only)
