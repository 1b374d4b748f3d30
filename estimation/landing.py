"""What a landing says of the pads: how far the fingers go on once the block has touched its place.

At the touch the pads bear what they bore while the block was carried, afterwards what the fingers push down
with. By pads that give as the rig says, `block_y` is the same before and after; where they give (1 + e)
times as much, or creep under the push, it is e times the give between the two too low. That is the
quantity by which a rise errs, so a landing is its most direct witness; it costs the touch's
own uncertainty, the fingers' speed times that of the moment.
"""

from __future__ import annotations

import numpy as np

from estimation.compliance import Slope
from hmmseg.robust import robust_sd

BEFORE = 4  # numerics: samples before the touch from which the fingers' height at it is extrapolated
SURE, RELIEVED = (
    4.0,
    0.25,
)  # chosen: noise sds, and share of the load, that a support bears once it is touched
LEAST_GIVE = 1e-6  # numerics: m; a push that squeezes nothing tells nothing


def landing(
    t: np.ndarray, reading: np.ndarray, give: np.ndarray, place: np.ndarray,
    touch: tuple[float, float], carry: np.ndarray, noise: float,
) -> Slope | None:  # fmt: skip
    """Weights whose sum with readings is the share e of the pads' give that the rig leaves out.

    `t`, `reading` (block_y by the rig's pads), `give` (their shear's), `place` (weights of the place's mean,
    summing to 1), `carry` (booleans): (num_timesteps,) in s and m; `touch`: mean and sd of the
    moment [s]; `noise`: sd of one reading [m]. None where too few samples tell.

    The height at the touch is a parabola through the last samples before it. Its error is how far a straight
    line lies from that, or how far the last samples themselves bend from one to the next, if that is more.
    """
    moment, moment_sd = touch
    usable = np.isfinite(reading) & np.isfinite(give)
    before = np.flatnonzero(carry & usable & (t <= moment))[-BEFORE:]
    if before.size < BEFORE or not np.any(place[usable] > 0):
        return None
    parabola, line = (_extrapolation(t[before] - moment, degree) for degree in (2, 1))
    weights = np.where(usable, place, 0.0)
    weights = weights / weights.sum()
    count = 1 / float((weights**2).sum())
    weights[before] -= parabola
    y = reading[before]
    change = float(weights @ np.where(usable, give, 0.0))
    if abs(change) < LEAST_GIVE:
        return None
    bend = max(abs(float((parabola - line) @ y)), float(np.abs(np.diff(y, 2)).max()))
    speed = float(np.polyfit(t[before] - moment, y, 1)[0])
    variance = (speed * moment_sd) ** 2 + bend**2 + noise**2 * (float((parabola**2).sum()) + 1 / count)
    return Slope(weights / change, variance / change**2, change=change)


def first_push(
    t: np.ndarray, net: np.ndarray, carry: np.ndarray, touch: tuple[float, float]
) -> tuple[float, float]:
    """Mean and sd of the touch [s] as forces have it, where that is before the boundary `touch`.

    `net` (num_timesteps,) [N]: net vertical force in units of 1 + a / g, constant while carried. Where pads
    yield, fingers go on after the touch as if they still carried; the support bears weight all the same.
    """
    held = net[carry & np.isfinite(net)]
    if held.size < BEFORE:
        return touch
    level = float(np.median(held))
    noise = robust_sd(held - level)
    before = np.flatnonzero(np.isfinite(net) & (t <= touch[0]))
    free = before[net[before] > level - max(SURE * noise, RELIEVED * abs(level))]
    if not free.size or free[-1] == before[-1]:
        return touch
    last, first = t[free[-1]], t[before[before > free[-1]][0]]
    return float(last + first) / 2, float(first - last) / 12**0.5


def _extrapolation(t: np.ndarray, degree: int) -> np.ndarray:
    """Weights (n,) that make of readings at times t the least-squares polynomial's value at 0."""
    return np.linalg.pinv(np.vander(t, degree + 1))[-1]
