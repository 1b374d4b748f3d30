"""What a hypothesis learns from a reading: one step of robust (Student-t) conjugate updates."""

from __future__ import annotations

import math

from hmmseg.levels import TAIL
from hmmseg.online.compiled import compiled
from hmmseg.online.layout import (
    ABOVE_KIND,
    AY,
    BIAS,
    CARRY,
    FORCE,
    FREE_KIND,
    FX1,
    FX2,
    FY1,
    FY2,
    LEVEL,
    LEVEL_SCALE,
    NET_X,
    OBJECTS,
    SCALES,
    SD_D,
    SD_VY,
    SD_Y,
    SHEAR,
    VELOCITY,
    VY,
    WIDTH_SCALE,
)
from hmmseg.online.scores import carry2, held_height, held_width, scale2

MOST_BIAS = 2000.0  # chosen: readings that a bias remembers: sensors drift
MOST_SCALE = 200.0  # chosen: and a scale
LEAST = 1e-12  # numerics: N^2, m^2; least squared scales are those of hmmseg.segmentation.fit:
FLOOR = 0.09  # chosen: ... 0.3 of a sample's own noise


@compiled
def _learn_mean(h, at, value, variance, share, most):
    """Robust conjugate update of a mean by a value of this variance, worth `share` of a reading."""
    if math.isnan(value):
        return
    precision = h[at + 1]
    robust = 1.0
    if precision > 0.0:
        residual = value - h[at] / precision
        robust = (TAIL + 1) / (TAIL + residual * residual / (variance + 1.0 / precision))
    add = share * robust / variance
    h[at] += add * value
    h[at + 1] += add
    if h[at + 1] > most / variance:
        forget = most / variance / h[at + 1]
        h[at] *= forget
        h[at + 1] *= forget


@compiled
def _learn_scale(h, which, residual, share, least):
    """Robust update of a squared scale, which stays above `least`."""
    if math.isnan(residual):
        return
    at = SCALES + 2 * which
    r2 = residual * residual
    robust = (TAIL + 1) / (TAIL + r2 / (h[at] / h[at + 1]))
    h[at] += share * robust * r2
    h[at + 1] += share
    if h[at + 1] > MOST_SCALE:
        forget = MOST_SCALE / h[at + 1]
        h[at] *= forget
        h[at + 1] *= forget
    h[at] = max(h[at], max(least, LEAST) * h[at + 1])


@compiled
def learn(h, kind, block, x, pads, gravity, share, levels):
    """Update a hypothesis by a reading taken in its state; `share`: of an independent reading."""
    if kind == FREE_KIND:
        noise = scale2(h, FORCE)
        for c in range(4):
            residual = x[FX1 + c] - h[BIAS + 2 * c] / h[BIAS + 2 * c + 1]
            _learn_mean(h, BIAS + 2 * c, x[FX1 + c], noise, share, MOST_BIAS)
            _learn_scale(h, FORCE, residual, share / 4, LEAST)
        return
    fx1, fy1 = x[FX1] - h[BIAS] / h[BIAS + 1], x[FY1] - h[BIAS + 2] / h[BIAS + 3]
    fx2, fy2 = x[FX2] - h[BIAS + 4] / h[BIAS + 5], x[FY2] - h[BIAS + 6] / h[BIAS + 7]
    noise = scale2(h, FORCE)
    _learn_scale(h, NET_X, fx1 + fx2, share, noise)
    _learn_scale(h, SHEAR, (fy1 - fy2) / 2, share, noise)
    weight, width = OBJECTS + 4 * block, OBJECTS + 4 * block + 2
    found = held_width(h, x, pads)
    if h[width + 1] > 0.0:
        _learn_scale(h, WIDTH_SCALE, found - h[width] / h[width + 1], share, FLOOR * x[SD_D] ** 2)
    _learn_mean(h, width, found, x[SD_D] * x[SD_D] + scale2(h, WIDTH_SCALE), share, math.inf)
    if kind == ABOVE_KIND:
        factor = 1.0 if math.isnan(x[AY]) else 1.0 + x[AY] / gravity
        fy = fy1 + fy2
        if h[weight + 1] > 0.0:
            _learn_scale(h, CARRY, fy - factor * h[weight] / h[weight + 1], share, noise)
        if factor > 0.1:  # in free fall a force says nothing of the weight
            _learn_mean(h, weight, fy / factor, carry2(h, x) / (factor * factor), share, math.inf)
        return
    _learn_scale(h, VELOCITY, x[VY], share, FLOOR * x[SD_VY] ** 2)
    if levels:
        height = held_height(h, x, pads)
        if h[LEVEL + 1] > 0.0:
            _learn_scale(h, LEVEL_SCALE, height - h[LEVEL] / h[LEVEL + 1], share, FLOOR * x[SD_Y] ** 2)
        _learn_mean(h, LEVEL, height, x[SD_Y] ** 2 + scale2(h, LEVEL_SCALE), share, math.inf)
