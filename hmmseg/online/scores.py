"""Log-likelihood of one reading under one hypothesis.

The emissions are those of hmmseg.segmentation.emissions (tested against them), with what is not yet known
integrated out: an unknown weight, width or level has a broad density over the range seen, and known ones
add their variance. And a hand that is free, or carries, may halt: without what follows, a halt would pass
for a rest on something, as that predicts positions so much better. What was just lifted moves, and what is
held still bears what it bore a reading before: a block not weighed yet, held on its support, would pass for
one carried at rest, whose weight is what the fingers happen to bear.
What a hypothesis learns is in `learning`.
"""

from __future__ import annotations

import math

from hmmseg.levels import MOVED
from hmmseg.online.compiled import compiled
from hmmseg.online.densities import log_between, log_broad, log_rising, log_student, log_sum
from hmmseg.online.layout import (
    AY,
    BIAS,
    CARRY,
    FORCE,
    FX1,
    FX2,
    FY1,
    FY2,
    GRIPPED,
    GROUND_KIND,
    LAST_D,
    LAST_FY,
    LAST_Y,
    LEVEL,
    LEVEL_SCALE,
    NET_X,
    OBJECTS,
    SCALES,
    SD_D,
    SD_FX,
    SD_FY,
    SD_VX,
    SD_VY,
    SD_Y,
    SHEAR,
    SPAN_D,
    SPAN_FORCE,
    SPAN_PRESS,
    SPAN_VX,
    SPAN_VY,
    SPAN_Y,
    VELOCITY,
    VX,
    VY,
    WIDTH_SCALE,
    D,
    Y,
)
from hmmseg.segmentation.emissions import ONE_FINGER, SHUT, STRAY, TOUCHING

STILL = 0.2  # prior: share of samples at which a hand that may move stands still,
CREEP = 0.005  # chosen: m/s; a hand at rest creeps by a few mm/s
JUST_LIFTED = 0.05  # prior: ... times this while a lift begins: slow, but a motion
ALIKE = 0.5  # prior: probability that a block not met yet is like one that was
_LOG_CLOSE, _LOG_STRAY, _LOG_REST = math.log1p(-STRAY), math.log(STRAY), math.log1p(-2 * STRAY)
_LOG_SILENT, _LOG_ONE = math.log1p(-ONE_FINGER), math.log(ONE_FINGER / 2)
_LOG_MOVING, _LOG_STILL = math.log1p(-STILL), math.log(STILL)


@compiled
def scale2(h, which):
    """Squared scale of one kind of residual."""
    at = SCALES + 2 * which
    return h[at] / h[at + 1]


@compiled
def carry2(h, x):
    """Variance of the net vertical force of what is carried."""
    return scale2(h, CARRY) + x[SD_FY] * x[SD_FY]


@compiled
def held_width(h, x, pads):
    """Width of what is held, as if rigid where a force is missing."""
    force = (x[FX1] - h[BIAS] / h[BIAS + 1]) * pads[0] - (x[FX2] - h[BIAS + 4] / h[BIAS + 5]) * pads[1]
    return x[D] if math.isnan(force) else x[D] + force


@compiled
def held_height(h, x, pads):
    """Height of what is held, as if rigid where a force is missing."""
    force = (x[FY1] - h[BIAS + 2] / h[BIAS + 3]) * pads[2] + (x[FY2] - h[BIAS + 6] / h[BIAS + 7]) * pads[3]
    return x[Y] if math.isnan(force) else x[Y] - force / 2


@compiled
def _ungripped(h, x, span):
    noise = scale2(h, FORCE)
    silent1 = silent2 = touch1 = touch2 = 0.0
    scale = math.sqrt(noise)
    for c in range(4):
        precision = h[BIAS + 2 * c + 1]
        force = x[FX1 + c] - h[BIAS + 2 * c] / precision
        silent = log_student(force, noise + 1.0 / precision)
        if c == 0:
            touch = log_between(force, 0.0, span, scale, span)
        elif c == 2:
            touch = log_between(-force, 0.0, span, scale, span)
        else:
            touch = log_between(force, -span, span, scale, 2 * span)
        if c < 2:
            silent1, touch1 = silent1 + silent, touch1 + touch
        else:
            silent2, touch2 = silent2 + silent, touch2 + touch
    one = log_sum(touch1 + silent2, silent1 + touch2)
    return log_sum(_LOG_SILENT + silent1 + silent2, _LOG_ONE + one)


@compiled
def _log_known(value, factor, h, at, variance, share, others, span, rising):
    """Log density of value = factor x quantity, whose evidence stands at h[at]; broad where unknown.

    `others`: how many further blocks, four numbers apart, it may be like. `rising`: what is unknown has a
    density that rises from 0, as a block of no weight is none.
    """
    precision = h[at + 1]
    if math.isnan(value):
        return 0.0
    if precision > 0.0:
        mean = h[at] / precision
        if rising:
            mean = max(mean, 0.0)
        total = variance + factor * factor / precision
        close = log_student(value - factor * mean, total)
        return log_sum(math.log1p(-share) + close, math.log(share) - math.log(span)) if share > 0 else close
    flat = -math.log(span)
    if rising:
        flat = log_rising(value, math.sqrt(variance), span)
    met, alike = 0, -math.inf
    for o in range(others):
        other = OBJECTS + 4 * o + (at - OBJECTS) % 4
        if h[other + 1] > 0.0:
            met += 1
            mean = h[other] / h[other + 1]
            alike = log_sum(
                alike, log_student(value - factor * mean, variance + factor * factor / h[other + 1])
            )
    if met == 0:
        return flat
    return log_sum(math.log(1 - ALIKE) + flat, math.log(ALIKE / met) + alike)


@compiled
def _standing(h, x, spans):
    """Log density of the velocities and the height of a hand that halts, over that of one that moves."""
    out = 0.0
    moving = scale2(h, VELOCITY)
    if not math.isnan(x[VX]):
        out += log_student(x[VX], x[SD_VX] ** 2 + moving) + math.log(spans[SPAN_VX])
    if not math.isnan(x[VY]):
        out += log_student(x[VY], x[SD_VY] ** 2 + moving) + math.log(spans[SPAN_VY])
    if not math.isnan(x[Y] - x[LAST_Y]):
        variance = 2 * x[SD_Y] ** 2 + scale2(h, LEVEL_SCALE)
        out += log_student(x[Y] - x[LAST_Y], variance) + math.log(spans[SPAN_Y])
    return out


@compiled
def free(h, x, spans):
    """Log-likelihood of a reading in free motion."""
    still = _standing(h, x, spans)
    if not math.isnan(x[D] - x[LAST_D]):
        variance = 2 * x[SD_D] ** 2 + scale2(h, WIDTH_SCALE)
        still += log_student(x[D] - x[LAST_D], variance) + math.log(spans[SPAN_D])
    broad = log_broad(x[VX], spans[SPAN_VX]) + log_broad(x[VY], spans[SPAN_VY])
    broad += log_broad(x[Y], spans[SPAN_Y]) + log_broad(x[D], spans[SPAN_D])
    out = _ungripped(h, x, spans[SPAN_FORCE]) + broad + log_sum(_LOG_MOVING, _LOG_STILL + still)
    return out + SHUT if x[GRIPPED] == 2.0 else out


@compiled
def held(h, block, x, spans, pads, num_blocks):
    """Log-likelihood of what a reading of any grip of this block shows."""
    span = spans[SPAN_FORCE]
    fx1, fy1 = x[FX1] - h[BIAS] / h[BIAS + 1], x[FY1] - h[BIAS + 2] / h[BIAS + 3]
    fx2, fy2 = x[FX2] - h[BIAS + 4] / h[BIAS + 5], x[FY2] - h[BIAS + 6] / h[BIAS + 7]
    out = log_between((fx1 - fx2) / 2, 0.0, span, math.sqrt(scale2(h, FORCE)), span)
    if x[GRIPPED] == 0.0:
        out += SHUT
    out += log_student(fx1 + fx2, scale2(h, NET_X) + x[SD_FX] * x[SD_FX]) + log_student(
        (fy1 - fy2) / 2, scale2(h, SHEAR)
    )
    spread = x[SD_D] * x[SD_D] + scale2(h, WIDTH_SCALE)
    width = OBJECTS + 4 * block + 2
    return out + _log_known(
        held_width(h, x, pads), 1.0, h, width, spread, TOUCHING, num_blocks, spans[SPAN_D], False
    )


@compiled
def _net_force(h, x):
    return x[FY1] - h[BIAS + 2] / h[BIAS + 3] + x[FY2] - h[BIAS + 6] / h[BIAS + 7]


@compiled
def lifted(h, block, x, spans, gravity, num_blocks, settled):
    """Log-likelihood of what a reading shows besides of a block above the ground.

    `settled`: probability that it has been there for a while, and may halt.
    """
    factor = 1.0 if math.isnan(x[AY]) else 1.0 + x[AY] / gravity
    out = _log_known(_net_force(h, x), factor, h, OBJECTS + 4 * block, carry2(h, x), 0.0, num_blocks,
                     spans[SPAN_FORCE], True)  # fmt: skip
    out += (
        log_broad(x[VX], spans[SPAN_VX]) + log_broad(x[VY], spans[SPAN_VY]) + log_broad(x[Y], spans[SPAN_Y])
    )
    still = STILL * max(settled, JUST_LIFTED)
    return out + log_sum(math.log1p(-still), math.log(still) + _standing(h, x, spans))


@compiled
def supported(h, kind, block, x, spans, pads, levels):
    """Log-likelihood of what a reading shows besides of a block on its support.

    `levels`: whether the height at which the block rests counts.
    """
    span, weight = spans[SPAN_PRESS], OBJECTS + 4 * block
    if h[weight + 1] > 0.0:
        most, soft = h[weight] / h[weight + 1], math.sqrt(carry2(h, x) + 1.0 / h[weight + 1])
    else:
        most, soft = span, math.sqrt(carry2(h, x))
    force = log_between(_net_force(h, x), -span, most, soft, span + most)
    moving = scale2(h, VELOCITY)
    upward, broad = log_student(x[VY], x[SD_VY] ** 2 + moving), log_broad(x[VY], spans[SPAN_VY])
    resting, change = force + upward, x[FY1] + x[FY2] - x[LAST_FY]
    if h[weight + 1] <= 0.0 and not math.isnan(change):  # what stands bears what it bore
        same = log_student(change, 4 * scale2(h, FORCE)) + log_student(x[VY], x[SD_VY] ** 2 + CREEP**2)
        resting = log_sum(_LOG_MOVING + resting, _LOG_STILL + same)
    if levels and h[LEVEL + 1] > 0.0:
        spread = x[SD_Y] * x[SD_Y] + scale2(h, LEVEL_SCALE) + 1.0 / h[LEVEL + 1]
        risen = held_height(h, x, pads) - h[LEVEL] / h[LEVEL + 1]
        level = log_student(risen, spread)
        resting, upward = resting + level, upward + level
        broad += log_student(risen, MOVED * MOVED)
    else:
        force += log_broad(x[Y], spans[SPAN_Y])
        resting += log_broad(x[Y], spans[SPAN_Y])
    aside = log_broad(x[VX], spans[SPAN_VX])
    if kind != GROUND_KIND:
        return aside + log_sum(_LOG_CLOSE + resting, _LOG_STRAY + broad + force)
    still = log_student(x[VX], x[SD_VX] ** 2 + moving)
    return log_sum(_LOG_REST + still + resting, force + _LOG_STRAY + aside + log_sum(upward, broad))
