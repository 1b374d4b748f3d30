"""Everything about the point of the best fit of the causes that held-out logs bear out."""

from __future__ import annotations

from collections.abc import Sequence

from simgap.attribution.posterior import fitted, forms
from simgap.robots.asked import Asked
from simgap.robots.blocks import NONE
from simgap.robots.discrepancy import learned
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.linear import linearise
from simgap.robots.model import Point
from simgap.robots.search import Found
from simgap.robots.whiten import covariances


def about(ask: Asked, found: Found, point: Point, borne: Sequence[str]) -> Found:
    """Everything linear about the best fit of what was borne out, its discrepancies, and that set there; what
    the search found out there is not worked out again."""
    composed, linear, cov, off = ask.composed, found.linear, found.covariances, found.discrepancy
    if point != linear.point:
        linear = linearise(composed, point, [*fitted_along(composed), *ask.candidates])
        cov = covariances(composed, linear, ask.factor)
        off = learned(cov, linear.residual) if len(cov.blocks) else NONE
    usable = [n for n in ask.candidates if n in linear.moved]
    whiten = cov.whitener(off)
    f = forms(gap_of(composed, linear, whiten, ask.phases, usable))
    model = fitted(f, tuple(sorted(usable.index(n) for n in borne)))
    return Found(linear, whiten, cov, off, f, (model,), tuple(usable[j] for j in model.effects))
