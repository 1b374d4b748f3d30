"""Independence proposals for the posterior: noise scales first, then all else given them.

Given the noise scales and the trial-to-trial scatter, log properties, common shifts and deviations
are very nearly jointly Gaussian: the observations are linear in properties that are known to a
percent. Their precision moves with the scales, a funnel that one Gaussian for all misses. So a
proposal draws the scales from a multivariate t (the Laplace approximation, or at times the
scatter's own prior, towards which its posterior has a long shoulder), then the rest from a
multivariate t about the generalised least squares solution under those scales. Alignments are
averaged here; the Metropolis-Hastings ratio puts that right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from estimation import priors
from estimation.mode import Mode

# Degrees of freedom: proposals need heavier tails than the posterior, in few dimensions the more so.
SCALES_TAIL, REST_TAIL = 5.0, 30.0
WIDEN = 1.1  # of the scales' Laplace covariance, likewise
FROM_PRIOR = 0.25  # share of proposals whose trial-to-trial scatter comes from its prior
NUM_SCALES = 6


@dataclass(frozen=True)
class Proposal:
    """Linear-Gaussian core about the mode; K observations, R parameters that are not scales.

    `rows` (K, R) derivatives of the predictions, `residual`, `variance` (K,), `channel` (K, 3);
    `precision` (R, R) and `gradient` (R,) of what does not depend on the scales; `order` (dim,)
    takes (scales, rest) to the posterior's own order of parameters.
    """

    rows: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    channel: np.ndarray
    precision: np.ndarray
    gradient: np.ndarray
    tau: np.ndarray
    scales: np.ndarray
    scales_chol: np.ndarray
    scales_prior: np.ndarray
    scales_prior_chol: np.ndarray
    rest: np.ndarray
    order: np.ndarray

    def draw(self, num: int, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Proposals (num, dim) and their log densities (num,)."""
        z = _student(random, num, NUM_SCALES, SCALES_TAIL)
        scales = self.scales + z @ self.scales_chol.T
        fresh = random.uniform(size=(num, 1)) < FROM_PRIOR
        scales = np.where(fresh, self.scales_prior + z @ self.scales_prior_chol.T, scales)
        mean, spread = self._given(scales)
        noise = _student(random, num, self.rest.size, REST_TAIL)
        rest = mean + np.einsum("wji,wj->wi", spread, noise)
        out = np.concatenate([scales, rest], axis=1)
        log_det = np.log(np.diagonal(spread, axis1=1, axis2=2)).sum(axis=1)
        return out[:, self.order], self._log_scales(scales) + _log_student(noise, REST_TAIL) - log_det

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density (num,) of proposing x (num, dim)."""
        back = x[:, np.argsort(self.order)]
        scales, rest = back[:, :NUM_SCALES], back[:, NUM_SCALES:]
        mean, spread = self._given(scales)
        noise = np.linalg.solve(np.swapaxes(spread, 1, 2), (rest - mean)[..., None])[..., 0]
        log_det = np.log(np.diagonal(spread, axis1=1, axis2=2)).sum(axis=1)
        return self._log_scales(scales) + _log_student(noise, REST_TAIL) - log_det

    def _given(self, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Generalised least squares under each row of scales (num, 6).

        Solutions (num, R) and inverse Cholesky factors (num, R, R) of the precisions.
        """
        noise2 = np.exp(2 * scales[:, :3]) @ self.channel.T * self.variance
        scatter2 = (self.tau * np.exp(scales[:, 3:])) ** 2 @ self.channel.T
        weight, size = 1 / (noise2 + scatter2), self.rest.size
        outer = (self.rows[:, :, None] * self.rows[:, None, :]).reshape(-1, size * size)
        precision = self.precision + (weight @ outer).reshape(-1, size, size)
        gradient = self.gradient + (weight * self.residual) @ self.rows
        spread = np.linalg.inv(np.linalg.cholesky(precision))
        step = np.einsum("wji,wj->wi", spread, np.einsum("wij,wj->wi", spread, gradient))
        return self.rest + step, spread

    def _log_scales(self, scales: np.ndarray) -> np.ndarray:
        parts = []
        for share, mean, chol in ((1 - FROM_PRIOR, self.scales, self.scales_chol),
                                  (FROM_PRIOR, self.scales_prior, self.scales_prior_chol)):  # fmt: skip
            z = np.linalg.solve(chol, (scales - mean).T).T
            parts.append(np.log(share) + _log_student(z, SCALES_TAIL) - np.log(np.diag(chol)).sum())
        return np.logaddexp(*parts)


def _student(random: np.random.RandomState, num: int, dim: int, tail: float) -> np.ndarray:
    chi2 = random.chisquare(tail, size=(num, 1)) / tail
    return random.normal(size=(num, dim)) / np.sqrt(chi2)


def _log_student(z: np.ndarray, tail: float) -> np.ndarray:
    """Log density of a standard multivariate t, (num,) for z (num, dim)."""
    dim = z.shape[1]
    constant = gammaln((tail + dim) / 2) - gammaln(tail / 2) - dim / 2 * np.log(tail * np.pi)
    return constant - (tail + dim) / 2 * np.log1p((z**2).sum(axis=1) / tail)


def proposal(mode: Mode) -> Proposal:
    """The proposal about a mode."""
    data = mode.data
    num = data.prior_mean.shape[0]
    properties, scales, rest = mode.x[:num], mode.x[num : num + NUM_SCALES], mode.x[num + NUM_SCALES :]
    common, deviations = rest[:3], rest[3:]
    channel = np.asarray(data.channel)
    coefficients = np.asarray(data.coefficients) * np.exp(properties)
    shared = np.broadcast_to(channel * np.asarray(data.common), (*coefficients.shape[:2], len(channel), 3))
    full = np.concatenate([coefficients, shared, np.asarray(data.shifts)], axis=-1)
    predicted = full @ np.concatenate([np.ones(num), common, deviations])
    there = np.asarray(data.there).mean(axis=1).ravel() > 0.5
    flat = [
        np.average(v, axis=1).reshape(-1, *v.shape[3:])[there]
        for v in (full, np.asarray(data.mean) - predicted, np.asarray(data.variance))
    ]
    free_weight = np.asarray(data.free_precision).ravel()
    free = np.asarray(data.free_shifts).reshape(free_weight.size, deviations.size)
    free_residual = np.asarray(data.free_mean).ravel() - free @ deviations
    diagonal = np.concatenate([1 / np.asarray(data.prior_sd) ** 2, np.ones(rest.size)])
    precision = np.diag(diagonal)
    precision[num + 3 :, num + 3 :] += (free.T * free_weight) @ free
    gradient = diagonal * np.concatenate([np.asarray(data.prior_mean) - properties, -rest])
    gradient[num + 3 :] += free.T @ (free_weight * free_residual)
    inside = slice(num, num + NUM_SCALES)
    laplace = WIDEN * mode.covariance[inside, inside]
    shoulder = np.diag([0.0] * 3 + [priors.TAU_LOG_SD**2] * 3)
    shoulder[:3, :3] = laplace[:3, :3]
    positions = np.concatenate(
        [np.arange(num, num + NUM_SCALES), np.arange(num), np.arange(num + NUM_SCALES, mode.x.size)]
    )
    return Proposal(
        flat[0], flat[1], flat[2], np.tile(channel, (data.mean.shape[0], 1))[there], precision, gradient,
        np.asarray(data.tau), scales, np.linalg.cholesky(laplace),
        np.concatenate([scales[:3], np.zeros(3)]), np.linalg.cholesky(shoulder),
        np.concatenate([properties, rest]), np.argsort(positions),
    )  # fmt: skip
