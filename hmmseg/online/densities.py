"""Log densities of single readings, compiled: Student-t, a uniform with soft edges, as off line."""

from __future__ import annotations

import math

from hmmseg.levels import TAIL
from hmmseg.online.compiled import compiled

_HALF = (TAIL + 1) / 2
_CONSTANT = math.lgamma(_HALF) - math.lgamma(TAIL / 2) - 0.5 * math.log(TAIL * math.pi)
_ROOT2 = math.sqrt(2.0)  # numerics: worked out once
_LEAST = -25.0  # numerics: of an edge, as in the emissions off line


@compiled
def log_sum(a, b):
    """log(exp(a) + exp(b))."""
    high, low = (a, b) if a > b else (b, a)
    return high + math.log1p(math.exp(low - high)) if low > -math.inf else high


@compiled
def log_student(residual, variance):
    """Log density of a Student-t residual whose squared scale is `variance`; 0 where missing."""
    if math.isnan(residual):
        return 0.0
    return _CONSTANT - 0.5 * math.log(variance) - _HALF * math.log1p(residual * residual / variance / TAIL)


@compiled
def _log_student_below(z):
    root = math.sqrt(z * z + TAIL)
    above = TAIL / (root * (root - z)) if z < 0.0 else 1.0 + z / root
    return 2 * math.log(above) + math.log(3.0 - above) - math.log(4.0)


@compiled
def log_between(value, low, high, scale, span):
    """Log density of a uniform on [low, high] of width `span` with noise-softened edges."""
    if math.isnan(value):
        return 0.0
    soft = _log_student_below((value - low) / scale) + _log_student_below((high - value) / scale)
    return max(soft, _LEAST) - math.log(span)


@compiled
def log_rising(value, scale, span):
    """Log density of value = w + noise (sd `scale`), w of a density that rises from 0 to `span`.

    The integral of 2 w / span^2 times the normal density over w > 0 is
    2 (v Phi(v / s) + s phi(v / s)) / span^2.
    """
    z = value / scale
    tail = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    share = z * 0.5 * math.erfc(-z / _ROOT2) + tail if z > -5.0 else tail / (z * z)
    return math.log(2 * scale / span) - math.log(span) + max(math.log(max(share, 1e-300)), _LEAST)


@compiled
def log_broad(value, span):
    """Log density of a value that may be anywhere in `span`; 0 where missing."""
    return 0.0 if math.isnan(value) else -math.log(span)
