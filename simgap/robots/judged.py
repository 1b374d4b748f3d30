"""Sets of effects judged each by the discrepancy that it itself leaves.

The discrepancy that a model leaves without a cause is as large as what the cause does, and under it the cause
gains little: it would be passed over for one that acts where nothing was off. So both are fitted together,
parameters and discrepancies' sizes in turn, from that discrepancy and from none, and a set's score is of its
rows as they are: the log determinant of their covariance is in it, so that what a set explains need not be
left to a discrepancy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.attribution.problem import Gap
from simgap.robots.blocks import NONE, Discrepancy
from simgap.robots.discrepancy import learned
from simgap.robots.gap import gap_of
from simgap.robots.linear import Linear
from simgap.robots.model import Composed
from simgap.robots.phases import Phases
from simgap.robots.whiten import Covariances, Whitener

TURNS = 2  # numerics: fits of parameters and of discrepancies in turn


@dataclass(frozen=True)
class Judged:
    """A set of effects with the discrepancy that it leaves, and its score by that."""

    names: tuple[str, ...]
    discrepancy: Discrepancy
    whiten: Whitener
    score: float


@dataclass(frozen=True)
class Judge:
    """Where sets are judged: the gap linear about a point; `near` is the discrepancy that is left there, and
    `log_odds` the prior log odds of one effect to act."""

    composed: Composed
    phases: Phases
    linear: Linear
    covariances: Covariances
    near: Discrepancy
    log_odds: float

    def __call__(self, names: Sequence[str]) -> Judged:
        """The set's score."""
        raw = gap_of(self.composed, self.linear, lambda rows: rows, self.phases, names)
        begin = (NONE, self.near) if self.near else (NONE,)
        return max((self._from(names, raw, off) for off in begin), key=lambda one: one.score)

    def _from(self, names: Sequence[str], raw: Gap, off: Discrepancy) -> Judged:
        seen = np.isfinite(self.linear.residual)
        left = np.zeros(seen.size)
        for _ in range(TURNS):
            f, model, _ = self._fitted(names, off)
            left[seen] = residual_of(raw, f, model)
            off = learned(self.covariances, left, self.near, off)
        f, model, whiten = self._fitted(names, off)
        prior = len(names) * (self.log_odds - f.log_odds)
        return Judged(tuple(names), off, whiten, model.score + prior - whiten.half_log_det)

    def _fitted(self, names: Sequence[str], off: Discrepancy) -> tuple[Forms, Model, Whitener]:
        whiten = self.covariances.whitener(off)
        f = forms(gap_of(self.composed, self.linear, whiten, self.phases, names))
        return f, fitted(f, tuple(range(len(names)))), whiten


def residual_of(raw: Gap, f: Forms, model: Model) -> np.ndarray:
    """What a set leaves of the rows (n,) of a gap in the channels' units, at a mode found in `f`."""
    left = raw.residual - raw.nuisance @ model.x[: raw.nuisance.shape[1]]
    for j, mine in coordinates(f, model.effects).items():
        c = raw.candidates[j]
        left = left - c.shift - c.jacobian @ (c.neutral + c.scale * model.x[mine] - c.at)
    return left
