"""Priors of properties and of model error; reasons in docs/properties.md.

Properties are log-normal: a factor of e^sd around blocks that a 4 N pinch can carry and a 75 mm workspace
holds. They are wide, so that the recording decides.

Model error is a share of the quantity on which each channel's equation rests (`estimation.design`): the
carried force, the pads' give along the grip, their shear deflection.
"""

import numpy as np

PROPERTY_MEDIAN = {"weight": 0.5, "width": 0.02, "height": 0.02}  # prior: N, m, m
PROPERTY_LOG_SD = {"weight": 1.5, "width": 1.0, "height": 1.0}  # prior: a factor of 3 to 5 either way

SCATTER_MEDIAN = np.array([1e-3, 1e-3, 0.02])  # prior: median share that differs between grips, by channel
SCATTER_LOG_SD = 1.0  # prior: of log(share / its median), normal: heavier tails would have no sd
COMMON = np.array([5e-4, 1e-3, 0.03])  # prior: sd of the share common to all grips, by channel


def log_prior(prop: str, coefficients: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Log density (N,), up to a constant, of values (N,) of sum(coefficients * property of an object). A sum
    of independent log-normal variables is approximated by the log-normal of the same first two moments
    (Fenton 1960), one with differences by the normal. -inf for non-positive values of a positive sum."""
    of_one = PROPERTY_LOG_SD[prop] ** 2
    each = PROPERTY_MEDIAN[prop] * np.exp(of_one / 2)
    mean = coefficients.sum() * each
    variance = (coefficients**2).sum() * each**2 * np.expm1(of_one)
    if (coefficients < 0).any():
        return -0.5 * (values - mean) ** 2 / variance
    log_variance = np.log1p(variance / mean**2)
    log_mean = np.log(mean) - log_variance / 2
    out = np.full(values.shape, -np.inf)
    positive = values > 0
    log_values = np.log(values[positive])
    out[positive] = -log_values - 0.5 * (log_values - log_mean) ** 2 / log_variance
    return out
