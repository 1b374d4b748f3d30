"""How much of the gap a set of causes explains, each cause by what is lost without it, by regime and channel.

Squares of residuals, whitened by the sensors' noise alone, are compared at points fitted exactly, each set at
its own least squares: a straight line from where a cause acts back to where it does not is no measure of a
friction that would have saturated half way. Flight, rest and motion in contact are regimes of their own, and
in each a cause is judged by the channels in which it acts: a model may lack one thing that makes bodies fall
slower, another that turns them, and a third where they strike, and what is left there does not take back what
was explained here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.verdict import Shares
from simgap.robots.fit import moved_to
from simgap.robots.gap import fitted_along
from simgap.robots.linear import Linear, base_at, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.rows import Rows
from simgap.robots.whiten import Whitener, covariances
from simgap.robots.windows import REGIMES

WHOLE = "whole"
SEEN = 3.0  # chosen: standard deviations of noise's squares: a smaller gap of a cell is none


@dataclass(frozen=True)
class Explained:
    """Squares by regime and channel: `before` (R, C) with nothing but what is fitted along, `after` (R, C)
    with all causes, `without` (J, R, C) with one of them left out, `floor` (R, C) what healthy twins
    have. `asked` (R,): regimes in which causes were sought; they rest on no other."""

    causes: tuple[str, ...]
    regimes: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    without: np.ndarray
    floor: np.ndarray
    asked: np.ndarray

    @property
    def left(self) -> np.ndarray:
        """Share (R,) of each regime's gap that is left; 1 where there is none to speak of."""
        return _left(self.before.sum(1), self.after.sum(1), self.floor.sum(1))

    @property
    def gone(self) -> float:
        """Share of the gap that all causes explain, in the regime in which it is largest."""
        return float(np.max(np.where(self.asked, 1.0 - self.left, 0.0), initial=0.0))

    @property
    def over_noise(self) -> float:
        """Root mean square of what is left, in units of the noise's."""
        return float(np.sqrt(self.after.sum() / max(self.floor.sum(), 1e-12)))

    @property
    def where_it_acts(self) -> np.ndarray:
        """Share (J, R) of the gap that is left where each cause acts: of channels by what is lost there
        without it. 1 where it takes nothing, or was not sought."""
        cell = _left(self.before, self.after, self.floor)
        lost = self.lost
        whole = lost.sum(2)
        return np.where(self.asked & (whole > 0), (lost * cell).sum(2) / np.where(whole > 0, whole, 1.0), 1.0)

    @property
    def lost(self) -> np.ndarray:
        """Squares (J, R, C) that come back where each cause is left out."""
        return np.maximum(self.without - self.after, 0.0)

    @property
    def part(self) -> np.ndarray:
        """Share (J, R) of what is explained in each regime that goes by each cause."""
        lost = self.lost.sum(2)
        return lost / np.maximum(lost.sum(0), 1e-12)

    @property
    def open_without(self) -> np.ndarray:
        """Of what is left (J, R) in each regime without a cause the share that is left with it, at most."""
        left = np.maximum(self.after - self.floor, 0.0).sum(1) + np.sqrt(2 * self.floor.sum(1))
        return np.where(self.asked, left / np.maximum(left + self.lost.sum(2), 1e-12), 1.0)

    def shares(self, rng: np.random.Generator) -> Shares:
        """All regimes together."""
        before, floor = float(self.before.sum()), float(self.floor.sum())
        after = min(float(self.after.sum()), before)
        lost = np.maximum(self.without.sum((1, 2)) - after, 0.0)
        return Shares.of(before, after, floor, lost, rng)


def _left(before: np.ndarray, after: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Share of a gap that is left; 1 where there is none to speak of."""
    gap = before - floor
    seen = gap > SEEN * np.sqrt(2 * floor)
    return np.where(seen, np.clip((after - floor) / np.where(seen, gap, 1.0), 0.0, 1.0), 1.0)


def regimes_of(rows: Rows) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the regimes that there are, and each row's (N,)."""
    there, number = np.unique(rows.regime, return_inverse=True)
    return (WHOLE,) if there.size == 1 else tuple(REGIMES[k] for k in there), number


def explained(
    composed: Composed,
    linear: Linear,
    sensor: Whitener,
    plain: Point,
    causes: Sequence[str],
    whole: Composed,
    healthy: Sequence[np.ndarray] = (),
) -> Explained:
    """Of causes that act at the linear model's point, fitted to its rows and told of all rows of `whole`;
    `plain`: where what is fitted along is without them; `healthy`: twins' residuals (N,) of its rows.

    An uncertain start takes up some of every window's noise, so that the noise's own squares are fewer than
    rows: they are the twins' mean where there are twins."""
    asked = _Squares.of(composed, linear, sensor)
    every, rows = asked, linear.rows
    if whole is not composed:
        there = linearise(whole, linear.point, [])
        every, rows = (
            _Squares.of(whole, there, covariances(whole, there).whitener()),
            whole.rows,
        )
    names, _ = regimes_of(rows)

    def least(*points: Point) -> np.ndarray:
        found = [*points, *(moved_to(composed, linear, sensor, p).point for p in points)]
        return every(min(found, key=lambda p: asked(p).sum()))

    along = fitted_along(composed)
    mine = {n: dict(linear.point[n]) for n in along}
    before = least(plain, mine) if along else every({})
    sought = np.isin(np.unique(rows.regime), np.unique(linear.rows.regime))
    floor = every.floor
    if healthy:
        floor[sought] = np.mean([asked.squares(r) for r in healthy], 0)
    if not causes:
        return Explained((), names, before, before, np.zeros((0, *before.shape)), floor, sought)
    after = least(linear.point)
    without = [least({n: v for n, v in linear.point.items() if n != out}) for out in causes]
    return Explained(tuple(causes), names, before, after, np.array(without), floor, sought)


@dataclass(frozen=True)
class _Squares:
    """Squares (R, C) of whitened residuals at a point, of rows that are `there` (N,), by `cell` (N,)."""

    composed: Composed
    sensor: Whitener
    there: np.ndarray
    cell: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(cls, composed: Composed, linear: Linear, sensor: Whitener) -> _Squares:
        names, regime = regimes_of(composed.rows)
        shape = len(names), len(composed.rows.channels)
        cell = regime * shape[1] + composed.rows.channel
        return cls(composed, sensor, np.isfinite(linear.residual), cell, shape)

    def __call__(self, point: Point) -> np.ndarray:
        return self.squares(self.composed.rows.observed - base_at(self.composed, point).rows)

    def squares(self, residual: np.ndarray) -> np.ndarray:
        """Of a residual (N,), by regime and channel (R, C)."""
        white = self.sensor(np.where(self.there & np.isfinite(residual), residual, 0.0)) ** 2
        return self._by_cell(np.where(self.there, white, 0.0))

    @property
    def floor(self) -> np.ndarray:
        return self._by_cell(self.there.astype(float))

    def _by_cell(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.cell, values, self.shape[0] * self.shape[1]).reshape(self.shape)
