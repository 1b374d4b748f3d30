"""How much of the gap a set of causes explains, each cause by what is lost without it, and by regime.

Squares of residuals, whitened by the sensors' noise alone, are compared at points fitted exactly, each set at
its own least squares: a straight line from where a cause acts back to where it does not is no measure of a
friction that would have saturated half way. Flight and contact are regimes of their own: a model may lack one
thing in flight and another where bodies strike, and what is left there does not take back what was explained
here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.shares import DRAWS, Shares
from simgap.robots.gap import fitted_along
from simgap.robots.linear import Linear, base_at
from simgap.robots.model import Composed, Point
from simgap.robots.rows import Rows
from simgap.robots.search import moved_to
from simgap.robots.whiten import Whitener

FREE, TOUCHING, WHOLE = "nothing touches", "bodies touch", "whole"


@dataclass(frozen=True)
class Explained:
    """Squares by regime: `before` (R,) with nothing but what is fitted along, `after` (R,) with all causes,
    `without` (J, R) with one of them left out, `floor` (R,) the noise's own."""

    causes: tuple[str, ...]
    regimes: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    without: np.ndarray
    floor: np.ndarray

    @property
    def left(self) -> np.ndarray:
        """Share (R,) of each regime's gap that is left; 1 where there is none to speak of."""
        gap = self.before - self.floor
        seen = gap > 3 * np.sqrt(2 * self.floor)
        return np.where(seen, np.clip((self.after - self.floor) / np.where(seen, gap, 1.0), 0.0, 1.0), 1.0)

    @property
    def part(self) -> np.ndarray:
        """Share (J, R) of what is explained in each regime that goes by each cause."""
        lost = np.maximum(self.without - self.after, 0.0)
        return lost / np.maximum(lost.sum(0), 1e-12)

    def shares(self, kept: Sequence[int], rng: np.random.Generator) -> Shares:
        """All regimes together, with draws of each kept cause's share."""
        before, floor = float(self.before.sum()), float(self.floor.sum())
        after = min(float(self.after.sum()), before)
        lost = np.maximum(self.without.sum(1) - after, 0.0)
        part = lost / max(float(lost.sum()), 1e-12)
        # Noise around what is left, and around what there was, makes the interval.
        drawn = after + np.sqrt(2 * floor + 4 * max(after - floor, 0.0)) * rng.standard_normal(DRAWS)
        told = np.clip((before - drawn) / max(before - floor, 1e-9), 0.0, 1.0)
        left = float(np.clip((after - floor) / max(before - floor, 1e-9), 0.0, 1.0))
        return Shares(before, after, floor, told[:, None] * part[list(kept)], left)


def regimes_of(rows: Rows) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of regimes, and each row's (N,)."""
    if rows.touching.all() or not rows.touching.any():
        return (WHOLE,), np.zeros(rows.log.size, int)
    return (FREE, TOUCHING), rows.touching.astype(int)


def explained(
    composed: Composed, linear: Linear, sensor: Whitener, plain: Point, causes: Sequence[str]
) -> Explained:
    """Of causes that act at the linear model's point; `plain`: where what is fitted along is without them."""
    names, of = regimes_of(linear.rows)
    there = np.isfinite(linear.residual)

    def squares(point: Point) -> np.ndarray:
        residual = linear.rows.observed - base_at(composed, point).rows
        white = sensor(np.where(there & np.isfinite(residual), residual, 0.0)) ** 2
        return np.bincount(of, np.where(there, white, 0.0), len(names))

    def least(point: Point) -> np.ndarray:
        return squares(moved_to(composed, linear, sensor, point))

    along = fitted_along(composed)
    mine = {n: dict(linear.point[n]) for n in along}
    bare = (least(plain), least(mine)) if along else (squares({}),)
    before = min(bare, key=np.sum)
    floor = np.bincount(of[there], minlength=len(names)).astype(float)
    if not causes:
        return Explained((), names, before, before, np.zeros((0, len(names))), floor)
    after = min(squares(linear.point), least(linear.point), key=np.sum)
    without = [least({n: v for n, v in linear.point.items() if n != out}) for out in causes]
    return Explained(tuple(causes), names, before, after, np.array(without), floor)
