"""The causes that held-out logs bear out, and everything about the point of their best fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.posterior import fitted, forms
from simgap.progress import Progress
from simgap.robots.borne_out import folds_of
from simgap.robots.discrepancy import learned
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.kept import Kept
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.prune import pruned
from simgap.robots.search import Found, Step, search
from simgap.robots.whiten import NONE, covariances

AGAIN = 3  # numerics: searches, each without what held-out logs did not bear out in the last


@dataclass(frozen=True)
class Asked:
    """In which windows which candidates are asked, which of them are `forced`, the `factor` (N,) on the
    noise's sd of each row, and the group of each log (as in `diagnose`)."""

    composed: Composed
    phases: Phases
    wanted: tuple[str, ...]
    forced: tuple[str, ...]
    factor: np.ndarray
    groups: Sequence[int] | None

    def fold(self, linear: Linear) -> np.ndarray:
        """The fold (N,) of each row."""
        return folds_of(linear, len(self.composed.recordings), self.groups)


def sought(ask: Asked, plain: Linear, tell: Progress, kept: Kept) -> tuple[Found, tuple[str, ...], Point]:
    """Where the search ended, which of its causes held-out logs bear out, and the point of their best fit.

    What they do not bear out may have kept another from being found: the search goes on without it.
    """
    composed, phases, factor = ask.composed, ask.phases, ask.factor
    begin, allowed, steps = None, ask.wanted, kept.of("search")
    for number in range(AGAIN):
        found = search(composed, phases, allowed, tell, ask.forced, factor, steps, plain, begin)
        if ask.forced:
            return found, found.best, found.linear.point
        tell("held-out logs")
        borne, point = kept(
            f"borne out {number + 1}",
            lambda found=found: pruned(composed, phases, found, ask.fold(found.linear), factor),
        )
        if borne == found.best:
            break
        allowed = tuple(n for n in allowed if n in borne or n not in found.best)
        begin, steps = Step(point, borne), kept.of(f"search {number + 2}")
    return found, borne, point


def about(ask: Asked, found: Found, point: Point, borne: Sequence[str]) -> Found:
    """Everything linear about the best fit of what was borne out, its discrepancies, and that set there; what
    the search found out there is not worked out again."""
    composed, linear, cov, off = ask.composed, found.linear, found.covariances, found.discrepancy
    if point != linear.point:
        linear = linearise(composed, point, [*fitted_along(composed), *ask.wanted])
        cov = covariances(composed, linear, ask.factor)
        off = learned(cov, linear.residual) if len(cov.blocks) else NONE
    elif other := [n for n in ask.wanted if n not in linear.moved and n not in linear.diverged]:
        more = linearise(composed, point, other, linear.starts)
        linear = linear.with_moved(more.moved, more.diverged)
    usable = [n for n in ask.wanted if n in linear.moved]
    whiten = cov.whitener(off)
    f = forms(gap_of(composed, linear, whiten, ask.phases, usable))
    model = fitted(f, tuple(sorted(usable.index(n) for n in borne)))
    return Found(linear, whiten, cov, off, f, (model,), tuple(usable[j] for j in model.effects))
