"""Independent draws of the scales: each scatter by its density on a grid, the noise by Laplace.

The scatter between grips is learned from few of them, so its posterior has a long shoulder towards
its prior, or a second mode there, which the Laplace approximation has not. Channels share next to
nothing, so each scatter's density is taken along its own axis through the mode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from estimation import priors
from estimation.density import NUM_CHANNELS
from estimation.mode import Mode
from estimation.posterior import Posterior

TAIL = 5.0  # numerics: degrees of freedom for the noise: proposals need heavier tails than the posterior
WIDEN = 1.1  # numerics: of the Laplace covariance, likewise
# numerics: share of proposals whose scatter is a t about its prior's median, heavier than any posterior
FROM_PRIOR = 0.1
STEP, REACH = 0.25, (-10.0, 10.0)  # numerics: of the grid, in log(share / its prior median)


@dataclass(frozen=True)
class Proposal:
    """Multivariate t of the noise scales: `mean` (3,), `chol` (3, 3); densities (3, G) of the scatters.

    `cells` are probabilities of the grid's intervals, of width STEP from REACH[0] on.
    """

    mean: np.ndarray
    chol: np.ndarray
    cells: np.ndarray

    def draw(self, num: int, random: np.random.RandomState) -> np.ndarray:
        """Proposals (num, 6)."""
        chi2 = random.chisquare(TAIL, size=(num, 1)) / TAIL
        noise = self.mean + random.normal(size=(num, NUM_CHANNELS)) / np.sqrt(chi2) @ self.chol.T
        cumulative = np.cumsum(self.cells, axis=1)
        chosen = [np.searchsorted(row / row[-1], random.uniform(size=num)) for row in cumulative]
        scatter = REACH[0] + STEP * (np.stack(chosen, axis=1) + random.uniform(size=(num, NUM_CHANNELS)))
        prior = priors.SCATTER_LOG_SD * random.standard_t(TAIL, size=scatter.shape)
        from_prior = random.uniform(size=scatter.shape) < FROM_PRIOR
        return np.concatenate([noise, np.where(from_prior, prior, scatter)], axis=1)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density (num,) of proposing x (num, 6)."""
        z = np.linalg.solve(self.chol, (x[:, :NUM_CHANNELS] - self.mean).T)
        out = _log_student((z**2).sum(axis=0), TAIL, NUM_CHANNELS) - np.log(np.diag(self.chol)).sum()
        scatter = x[:, NUM_CHANNELS:]
        cell = np.floor((scatter - REACH[0]) / STEP).astype(int)
        inside = (cell >= 0) & (cell < self.cells.shape[1])
        drawn = self.cells[np.arange(NUM_CHANNELS), np.where(inside, cell, 0)] / STEP
        z2 = (scatter / priors.SCATTER_LOG_SD) ** 2
        prior = np.exp(_log_student(z2, TAIL, 1)) / priors.SCATTER_LOG_SD
        return out + np.log((1 - FROM_PRIOR) * np.where(inside, drawn, 0.0) + FROM_PRIOR * prior).sum(axis=1)


def proposal(post: Posterior, mode: Mode) -> Proposal:
    """The proposal about a mode."""
    middle = np.arange(REACH[0] + STEP / 2, REACH[1], STEP)
    cells = []
    for c in range(NUM_CHANNELS):
        along = np.repeat(mode.scales[None], middle.size, axis=0)
        along[:, NUM_CHANNELS + c] = middle
        log_prob = post.log_prob(along)
        cells.append(np.exp(log_prob - log_prob.max()))
    noise = WIDEN * mode.covariance[:NUM_CHANNELS, :NUM_CHANNELS]
    found = np.stack([row / row.sum() for row in cells])
    return Proposal(mode.scales[:NUM_CHANNELS], np.linalg.cholesky(noise), found)


def _log_student(z2: np.ndarray, tail: float, dim: int) -> np.ndarray:
    """Log density of a t of unit scale in `dim` dimensions, from squared distances."""
    constant = gammaln((tail + dim) / 2) - gammaln(tail / 2) - dim / 2 * np.log(tail * np.pi)
    return constant - (tail + dim) / 2 * np.log1p(z2 / tail)
