"""The background: what no candidate explains, by group of rows, with a variance of its own.

The rows of a group (a channel in a part, in a band) have variance phi, one as a rule. Beforehand log phi is
normal, as stated noise is a little off, and with some probability log-uniform above that: there the model
is off for reasons of its own. Averaged over phi, what a group's squares say grows with their logarithm only,
so that no group decides alone (a scale mixture of normals: West, Biometrika 74, 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STATED = 0.3  # prior: sd of log variance about the stated one: noise stated to 15 %
OFF = 0.1  # prior: share of groups, beforehand, in which the model is off by itself
NEAR, FAR = 13, 20  # numerics: points of the grid
LARGEST = 1e6  # numerics: the most that a variance exceeds the stated one


@dataclass(frozen=True)
class Background:
    """A grid of log variances and the log of their prior weights; `plain` knows no background at all."""

    log_phi: np.ndarray
    log_prior: np.ndarray

    @classmethod
    def usual(cls, stated: float = STATED, off: float = OFF) -> Background:
        """Stated noise, or the model off."""
        grid = np.concatenate(
            [np.linspace(-3, 3, NEAR) * stated, np.linspace(4 * stated, np.log(LARGEST), FAR)]
        )
        normal = -0.5 * (grid[:NEAR] / stated) ** 2
        log_prior = np.concatenate([
            np.log(1 - off) + normal - np.logaddexp.reduce(normal), np.full(FAR, np.log(off / FAR)),
        ])  # fmt: skip
        return cls(grid, log_prior)

    @classmethod
    def plain(cls) -> Background:
        """Noise exactly as stated."""
        return cls(np.zeros(1), np.zeros(1))

    def marginal(
        self, energy: np.ndarray, count: np.ndarray, shift: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log density (G,) of groups with these squares and counts, but for (2 pi)^(-count/2), and their
        expected precisions (G,). `shift`: log variance that the groups have in any case."""
        log_phi = self.log_phi[:, None] + shift
        precision = np.exp(-log_phi)
        each = self.log_prior[:, None] - 0.5 * (count * log_phi + energy * precision)
        most = each.max(axis=0)
        weight = np.exp(each - most)
        total = weight.sum(axis=0)
        return most + np.log(total), (weight * precision).sum(axis=0) / total
