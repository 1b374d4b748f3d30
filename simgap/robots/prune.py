"""Which effects of a set held-out logs bear out, each set judged where it fits best.

A search ends on more effects than there are: each was the best at its time, and some of them stand in for
others. They are taken out one by one, and after each everything is fitted anew and linearised there: a set
judged about the point of a larger one is judged by straight lines that do not reach to its own best fit, and
loses causes that no log would miss.
"""

from __future__ import annotations

import numpy as np

from simgap.progress import Progress
from simgap.robots.asked import Asked
from simgap.robots.borne_out import weakest
from simgap.robots.discrepancy import learned
from simgap.robots.gap import fitted_along
from simgap.robots.kept import Kept
from simgap.robots.linear import linearise
from simgap.robots.model import Point
from simgap.robots.search import Found, exchanged, search
from simgap.robots.settle import settled
from simgap.robots.whiten import covariances

AGAIN = 3  # numerics: searches, each from what held-out logs leave of the last


def pruned(ask: Asked, found: Found) -> tuple[tuple[str, ...], Point]:
    """The effects that are left, and the point of their best fit."""
    composed, along = ask.composed, fitted_along(ask.composed)
    kept, point, linear, whiten = found.best, found.linear.point, found.linear, found.whiten
    off = found.discrepancy
    while kept:
        f = ask.forms(linear, whiten, kept)
        out = weakest(f.gap, range(len(kept)), ask.fold[np.isfinite(linear.residual)])
        if out is None:
            break
        kept = tuple(n for j, n in enumerate(kept) if j != out)
        left = {n: values for n, values in point.items() if n in along or n in kept}
        there = settled(composed, left, ask.factor, begin=off)
        point = there.point
        linear = linearise(composed, point, [*along, *kept])
        cov = covariances(composed, linear, ask.factor)
        off = learned(cov, linear.residual, begin=there.discrepancy)
        whiten = cov.whitener(off)
    return kept, point


def sought(ask: Asked, tell: Progress, kept: Kept) -> tuple[Found, tuple[str, ...], Point]:
    """Where the search ended, which of its causes held-out logs bear out, and the point of their best fit.

    What they do not bear out was the best at its time, and may have kept what belongs in the place of another
    from being found: the search goes on from what they leave, if that leads on.
    """
    begin, part = None, kept.of("search")
    for number in range(AGAIN):
        found = search(ask, tell, part, begin)
        if ask.forced:
            return found, found.best, found.linear.point
        tell("held-out logs")
        borne, point = part("borne out", lambda found=found: pruned(ask, found))
        if borne == found.best:
            break
        begin = part("exchanged", lambda point=point, borne=borne: exchanged(ask, point, borne))
        if begin is None:
            break
        part = kept.of(f"search {number + 2}")
    return found, borne, point
