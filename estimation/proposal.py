"""Independent draws of the scales: a multivariate t about the mode, or the scatter's own prior.

The scatter between grips is learned from few of them, so its posterior has a long shoulder towards
its prior that the Laplace approximation has not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from estimation import priors
from estimation.mode import Mode
from estimation.posterior import NUM_CHANNELS

TAIL = 5.0  # degrees of freedom: proposals need heavier tails than the posterior
WIDEN = 1.1  # of the Laplace covariance, likewise
FROM_PRIOR = 0.25  # share of proposals whose scatter comes from its prior


@dataclass(frozen=True)
class Proposal:
    """Mixture of two multivariate t distributions: weights, means (2, D) and Cholesky factors (2, D, D)."""

    means: np.ndarray
    chols: np.ndarray

    def draw(self, num: int, random: np.random.RandomState) -> np.ndarray:
        """Proposals (num, D)."""
        chi2 = random.chisquare(TAIL, size=(num, 1)) / TAIL
        z = random.normal(size=(num, self.means.shape[1])) / np.sqrt(chi2)
        which = (random.uniform(size=num) < FROM_PRIOR).astype(int)
        return self.means[which] + np.einsum("wij,wj->wi", self.chols[which], z)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density (num,) of proposing x (num, D)."""
        dim = x.shape[1]
        constant = gammaln((TAIL + dim) / 2) - gammaln(TAIL / 2) - dim / 2 * np.log(TAIL * np.pi)
        parts = []
        for share, mean, chol in zip((1 - FROM_PRIOR, FROM_PRIOR), self.means, self.chols, strict=True):
            z = np.linalg.solve(chol, (x - mean).T)
            log_student = constant - (TAIL + dim) / 2 * np.log1p((z**2).sum(axis=0) / TAIL)
            parts.append(np.log(share) + log_student - np.log(np.diag(chol)).sum())
        return np.logaddexp(*parts)


def proposal(mode: Mode) -> Proposal:
    """The proposal about a mode."""
    laplace = WIDEN * mode.covariance
    shoulder = np.diag([0.0] * NUM_CHANNELS + [priors.SCATTER_LOG_SD**2] * NUM_CHANNELS)
    shoulder[:NUM_CHANNELS, :NUM_CHANNELS] = laplace[:NUM_CHANNELS, :NUM_CHANNELS]
    prior = np.concatenate([mode.scales[:NUM_CHANNELS], np.zeros(NUM_CHANNELS)])
    return Proposal(
        np.stack([mode.scales, prior]), np.stack([np.linalg.cholesky(laplace), np.linalg.cholesky(shoulder)])
    )
