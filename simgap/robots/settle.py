"""Where a set settles: its exact fit, each by the discrepancy that the last one leaves."""

from __future__ import annotations

import numpy as np

from simgap.robots.discrepancy import learned
from simgap.robots.fit import Fit, moved_to
from simgap.robots.linear import linearise
from simgap.robots.model import Composed, Point
from simgap.robots.whiten import Whitener, covariances

ROUNDS = 5  # numerics: exact fits, each linearised where the last one ended
SETTLED = 2.0  # numerics: nats that a further one must gain


def settled(
    composed: Composed, point: Point, factor: np.ndarray | None = None, whiten: Whitener | None = None
) -> Fit:
    """The set's best point from a start, and what that gained; a point that is as good stays. Discrepancies
    are learned anew on the way unless `whiten` is given; `factor` (N,) multiplies the noise's sd."""
    gained = 0.0
    for _ in range(ROUNDS if point else 0):
        rough = linearise(composed, point, [])
        white = whiten
        if white is None:
            cov = covariances(composed, rough, factor)
            white = cov.whitener(learned(cov, rough.residual))
        fit = moved_to(composed, rough, white, point)
        if fit.gained < SETTLED:
            break
        point, gained = fit.point, gained + fit.gained
    return Fit(point, gained)
