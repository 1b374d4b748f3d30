"""The posterior mode of the scales, and the Laplace approximation around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.posterior import NUM_CHANNELS, Posterior

STEP = 1e-3  # numerics: of the scales, all logarithms, for derivatives by central differences
# numerics: of log(share / its prior median): a large share is a mode of its own
STARTS = np.arange(-1.0, 9.0, 1.0)


@dataclass(frozen=True)
class Mode:
    """Mode (6,) of the scales and their covariance (6, 6); unknowns (Q,) there and theirs (Q, Q).

    The covariance of the unknowns holds at the scales' mode.
    """

    scales: np.ndarray
    covariance: np.ndarray
    unknowns: np.ndarray
    unknowns_covariance: np.ndarray
    converged: bool


def find_mode(post: Posterior) -> Mode:
    """Mode by BFGS from the best of a few shares a channel, with derivatives by central differences."""
    from scipy.optimize import minimize  # slow to import

    size = 6
    steps = STEP * np.eye(size)

    def loss(x: np.ndarray) -> float:
        return -float(post.log_prob(x[None])[0])

    def gradient(x: np.ndarray) -> np.ndarray:
        both = post.log_prob(np.concatenate([x + steps, x - steps]))
        return -(both[:size] - both[size:]) / (2 * STEP)

    found = minimize(loss, _start(post), jac=gradient, method="BFGS", options={"gtol": 1e-4})
    hessian = np.array([(gradient(found.x + h) - gradient(found.x - h)) / (2 * STEP) for h in steps])
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    covariance = (vectors / np.maximum(values, 0.1)) @ vectors.T
    mean, chol = post.given(found.x[None])
    num = len(post.design.unknowns)
    spread = np.linalg.inv(chol[0])[:, :num]
    slope = float(np.abs(gradient(found.x)).max())
    return Mode(found.x, covariance, post.reference + mean[0, :num], spread.T @ spread, slope < 1e-2)


def _start(post: Posterior) -> np.ndarray:
    """Scales (6,) from which to climb: each channel's share the best of STARTS, one after the other."""
    best = np.zeros(2 * NUM_CHANNELS)
    for c in range(NUM_CHANNELS):
        tried = np.repeat(best[None], STARTS.size, axis=0)
        tried[:, NUM_CHANNELS + c] = STARTS
        best = tried[int(np.argmax(post.log_prob(tried)))]
    return best
