"""The background: what no candidate explains, by group of rows, with a variance of its own.

The rows of a group (a channel in a part, in a band) have variance phi, one as a rule. Beforehand log phi is
normal, as stated noise is a little off, and with some probability log-uniform above that: there the model
is off for reasons of its own. By what does not matter (a tolerance) any group is as likely off as not.
Averaged over phi, what a group's squares say grows with their logarithm only, so that no group decides alone
(a scale mixture of normals: West, Biometrika 74, 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STATED = 0.3  # prior: sd of log variance about the stated one: noise stated to 15 %
OFF = 0.1  # prior: share of groups, beforehand, in which the model is off by itself
WITHIN = 0.5  # prior: share of groups in which it is off by less than matters
NEAR, FAR = 13, 20  # numerics: points of the grid
NEAR_BY = 3.5 * STATED  # numerics: log variance between the two parts of the grid
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

    def tolerant(self, most: np.ndarray) -> np.ndarray:
        """The log prior (grid, G) of groups whose variance may be so much (G,) without it mattering."""
        inside = (self.log_phi[:, None] > NEAR_BY) & (self.log_phi[:, None] <= np.log(most))
        number = inside.sum(0)
        share = np.where(number > 0, WITHIN, 0.0)
        # What is beyond any tolerance stays as likely as it was.
        usual = self.log_phi <= NEAR_BY
        taken = share * np.exp(self.log_prior[usual]).sum()
        with np.errstate(divide="ignore"):
            more = np.log(np.where(inside, taken / np.maximum(number, 1), 0.0))
        less = np.where(usual[:, None], np.log1p(-share), 0.0)
        return np.logaddexp(self.log_prior[:, None] + less, more)

    def marginal(
        self,
        energy: np.ndarray,
        count: np.ndarray,
        shift: np.ndarray | float = 0.0,
        most: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log density (G,) of groups with these squares and counts, but for (2 pi)^(-count/2), and their
        expected precisions (G,). `shift`: log variance that the groups have in any case; `most` (G,): the
        variance that does not matter."""
        log_phi = self.log_phi[:, None] + shift
        precision = np.exp(-log_phi)
        prior = self.log_prior[:, None] if most is None else self.tolerant(most)
        each = prior - 0.5 * (count * log_phi + energy * precision)
        peak = each.max(axis=0)
        weight = np.exp(each - peak)
        total = weight.sum(axis=0)
        return peak + np.log(total), (weight * precision).sum(axis=0) / total
