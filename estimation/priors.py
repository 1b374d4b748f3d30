"""Priors of the properties and of the noise model, with their reasons in docs/model.md.

Properties are log-normal: blocks that a 4 N pinch can carry and a 75 mm workspace holds, a
factor of e^sd either way. They are wide: the recording decides.
"""

from __future__ import annotations

import numpy as np

PROPERTY_MEDIAN = {"weight": 0.5, "width": 0.02, "height": 0.02}  # N, m, m
PROPERTY_LOG_SD = {"weight": 1.5, "width": 1.0, "height": 1.0}
TAU_LOG_SD = 1.0  # normal prior of log(tau / its prior median)


def property_priors(names: tuple[tuple[str, str], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (num_properties,) of the log properties."""
    mean = np.array([np.log(PROPERTY_MEDIAN[prop]) for _, prop in names])
    return mean, np.array([PROPERTY_LOG_SD[prop] for _, prop in names])
