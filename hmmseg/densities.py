"""Log densities of residuals, for arrays and single numbers alike; `hmmseg.online` compiles this source
too."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hmmseg.levels import TAIL

EDGE = -25.0  # chosen: nats, least log probability of an edge: one wild sample does not rule out a state
STUDENT = math.lgamma((TAIL + 1) / 2) - math.lgamma(TAIL / 2) - 0.5 * math.log(TAIL * math.pi)  # physics


def log_student(residual: Any, scale: Any) -> Any:
    """Log density of a Student-t residual; 0 if the residual is missing (NaN)."""
    return np.nan_to_num(STUDENT - np.log(scale) - (TAIL + 1) / 2 * np.log1p((residual / scale) ** 2 / TAIL))


def log_student_below(z: Any) -> Any:
    """Log probability that a standard Student-t variable (of TAIL degrees of freedom) lies below z."""
    root = np.sqrt(z**2 + TAIL)
    small = TAIL / (root * (root + np.abs(z)))  # 1 - |z| / root without cancellation
    above = small + (z >= 0) * (2 - 2 * small)
    return 2 * np.log(above) + np.log(3 - above) - math.log(4)


def log_between(value: Any, low: float, high: float, scale: float) -> Any:
    """Log density of a uniform on [low, high] with edges softened by noise; 0 if missing."""
    soft = log_student_below((value - low) / scale) + log_student_below((high - value) / scale)
    return np.nan_to_num(np.maximum(soft, EDGE) - np.log(high - low))
