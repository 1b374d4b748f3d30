"""Emissions of plain ordered tasks: independent Student t features, tempered for dependence.

Neighbouring cells and different channels repeat each other's evidence. Multiplying their
likelihoods as if independent makes boundaries overconfident, so the log-likelihood is multiplied by
`temper`, the share of independent observations: one over the integrated autocorrelation time of the
residuals, times the effective number of features over their number (participation ratio of the
residual correlation's eigenvalues).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

DOF = 4.0  # cited: heavy tails: a transient moves neither location nor scale much
ONE_CELL = 1e-9  # numerics: a state without even so much weight is left as it is


@dataclass(frozen=True)
class StudentEmissions:
    """`loc`, `scale` (num_states, num_features) of standardised features; `temper` in (0, 1]."""

    loc: np.ndarray
    scale: np.ndarray
    temper: float = 1.0

    def log_likelihoods(self, values: np.ndarray) -> np.ndarray:
        """Tempered log-likelihoods (num_cells, num_states); a missing feature adds nothing."""
        z2 = ((values[:, None] - self.loc) / self.scale) ** 2
        constant = gammaln((DOF + 1) / 2) - gammaln(DOF / 2) - np.log(np.pi * DOF) / 2
        log_density = constant - np.log(self.scale) - (DOF + 1) / 2 * np.log1p(z2 / DOF)
        return self.temper * np.nansum(log_density, axis=2)


def update(emissions: StudentEmissions, values: np.ndarray, weights: np.ndarray,
           floor: float) -> StudentEmissions:  # fmt: skip
    """One EM step for location and scale (Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 1989).

    `values` (num_cells, num_features) of all trials, `weights` (num_cells, num_states) the
    posterior state probabilities; scales are kept above `floor`.
    """
    loc, scale = emissions.loc.copy(), emissions.scale.copy()
    known = np.isfinite(values)
    x = np.where(known, values, 0.0)
    for k in range(len(loc)):
        gamma = weights[:, k, None] * known
        u = gamma * (DOF + 1) / (DOF + ((x - loc[k]) / scale[k]) ** 2)
        enough = (total := gamma.sum(0)) > ONE_CELL
        loc[k, enough] = ((u * x).sum(0)[enough]) / u.sum(0)[enough]
        spread = (u * (x - loc[k]) ** 2).sum(0)[enough] / total[enough]
        scale[k, enough] = np.sqrt(spread)
    return StudentEmissions(loc, np.maximum(scale, floor), emissions.temper)


def from_weights(values: np.ndarray, weights: np.ndarray, floor: float, temper: float,
                 iterations: int = 10) -> StudentEmissions:  # fmt: skip
    """Emissions for given posterior state probabilities, from moments on."""
    known = np.isfinite(values)
    x = np.where(known, values, 0.0)
    total = np.maximum(weights.T @ known, ONE_CELL)
    loc = (weights.T @ x) / total
    variance = np.maximum((weights.T @ x**2) / total - loc**2, 0.0)
    emissions = StudentEmissions(loc, np.maximum(np.sqrt(variance), floor), temper)
    for _ in range(iterations):
        emissions = update(emissions, values, weights, floor)
    return emissions


def residuals(emissions: StudentEmissions, values: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Standardised residuals (num_cells, num_features) along a path, heavy tails brought in."""
    z = (values - emissions.loc[path]) / emissions.scale[path]
    return np.arctan(np.nan_to_num(z))


def independent_share(trials: Sequence[np.ndarray]) -> float:
    """Share of independent observations in residuals [(num_cells, num_features), ...]."""
    pooled = np.vstack(trials)
    spread = pooled.std(0)
    used = spread > 1e-6
    if not used.any():
        return 1.0
    eigenvalues = np.linalg.eigvalsh(np.atleast_2d(np.corrcoef(pooled[:, used].T)))
    breadth = eigenvalues.sum() ** 2 / (eigenvalues**2).sum() / used.sum()
    times = [_autocorrelation_time(r[:, used]) for r in trials if len(r) >= 8]
    return float(breadth / max(np.median(times), 1.0)) if times else float(breadth)


def _autocorrelation_time(r: np.ndarray) -> float:
    """Integrated autocorrelation time [cells], features pooled, up to its first crossing of 0.05."""
    x = r - r.mean(0)
    n = len(x)
    transform = np.fft.rfft(x, 2 * n, axis=0)
    covariance = np.fft.irfft(np.abs(transform) ** 2, axis=0)[: n // 2].sum(1)
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    end = int(np.argmax(rho < 0.05)) or len(rho)
    return float(1 + 2 * rho[1:end].sum())
