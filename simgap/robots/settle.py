"""Where a set settles: its parameters and the discrepancy that they leave, both at their best.

By a discrepancy that is left at a bad start a set gains little where it should move, and to fit and to learn
in turn would end there. So a fit by the sensors' noise alone is tried as well, and each is judged by what it
leaves once the discrepancy is learned anew: the log likelihood of the rows, determinant and all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.robots.blocks import NONE, Discrepancy
from simgap.robots.discrepancy import learned
from simgap.robots.fit import Fit, moved_to, prior_cost
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.whiten import Whitener, covariances

ROUNDS = 5  # numerics: exact fits, each linearised where the last one ended
SETTLED = 2.0  # numerics: nats that a further one must gain


@dataclass(frozen=True)
class _Place:
    """The gap at a point, its whitening by the discrepancy that is left and by the sensors' noise alone, the
    log likelihood with the prior [nats], and that discrepancy."""

    linear: Linear
    whiten: Whitener
    sensor: Whitener
    value: float
    off: Discrepancy


def settled(
    composed: Composed,
    point: Point,
    factor: np.ndarray | None = None,
    whiten: Whitener | None = None,
    begin: Discrepancy = NONE,
) -> Fit:
    """The set's best point from a start, and what that gained; a point that is as good stays. Discrepancies
    are learned anew on the way, from sizes to `begin` with, unless `whiten` is given; `factor` (N,)
    multiplies the noise's sd."""
    if not any(point.values()):
        return Fit(point, 0.0, begin)
    best = _place(composed, point, factor, whiten, begin)
    first, scales = best.value, [best.whiten] if best.sensor is best.whiten else [best.sensor, best.whiten]
    for _ in range(ROUNDS):
        moved = [moved_to(composed, best.linear, scale, best.linear.point).point for scale in scales]
        places = [_place(composed, there, factor, whiten, best.off) for there in moved]
        new = max(places, key=lambda place: (-place.linear.dropped, place.value))
        if new.linear.dropped > best.linear.dropped or new.value < best.value + SETTLED:
            break
        best, scales = new, [new.whiten]
    return Fit(best.linear.point, best.value - first, best.off)


def _place(
    composed: Composed, point: Point, factor: np.ndarray | None, whiten: Whitener | None, begin: Discrepancy
) -> _Place:
    linear = linearise(composed, point, [])
    sensor, off = whiten, NONE
    if whiten is None:
        cov = covariances(composed, linear, factor)
        off = learned(cov, linear.residual, begin=begin)
        sensor = cov.whitener()
        whiten = cov.whitener(off) if off else sensor
    white = whiten(np.where(np.isfinite(linear.residual), linear.residual, 0.0))
    value = -0.5 * float(white @ white) - whiten.half_log_det - prior_cost(composed, point)
    return _Place(linear, whiten, whiten if sensor is None else sensor, value, off)
