"""Posterior-predictive checks: could recordings like these come from the fitted model?

For each channel the discrepancy is the weighted scatter of the grips' means about their
prediction, with the trial-to-trial scatter at its prior median (it may not absorb what it is
asked about): its posterior-predictive p-value compares observed with replicated scatter (Gelman,
Meng, Stern 1996). A small p-value says that grips differ by more than sensors and hand explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.design import Design
from estimation.observations import CHANNELS
from estimation.posterior import Data, split
from estimation.sampler import Draws

NUM_REPLICATES = 400
SMALL = 0.005
MEANING = {
    "force": "the net vertical force while carried differs between grips",
    "distance": "the distance of the fingers while held differs between grips",
    "rise": "the height by which a block rises or sinks differs between trials (slip in the grip does that)",
}


@dataclass(frozen=True)
class PredictiveCheck:
    """Posterior-predictive p-value per channel, and warnings for those that are small.

    `excess`: sd between grips beyond the sensors' noise, posterior median, per channel (N, m, m).
    """

    p_values: dict[str, float]
    excess: dict[str, float]
    warnings: tuple[str, ...]

    def to_json(self) -> dict:
        """p-values and excess scatter by channel."""
        return {
            name: {"p_value": p, "scatter_between_grips": self.excess[name]}
            for name, p in self.p_values.items()
        }


def check(design: Design, data: Data, draws: Draws, rng: np.random.Generator) -> PredictiveCheck:
    """Check every channel that was observed more often than it has parameters."""
    flat = draws.flat
    x = flat[rng.integers(len(flat), size=NUM_REPLICATES)]
    num = len(design.names)
    there = design.there.all(axis=1)
    mean, variance = design.mean.mean(axis=1), design.variance.mean(axis=1)
    coefficients, shifts = design.coefficients.mean(axis=1), design.shifts.mean(axis=1)
    log_properties, log_scale, log_tau, common, deviations = split(x, num)
    predicted = np.einsum("top,rp->rto", coefficients, np.exp(log_properties))
    predicted += np.einsum("ton,rn->rto", shifts, deviations)
    predicted += (design.common * common)[:, None, design.channel]
    spread = variance * np.exp(2 * log_scale)[:, None, design.channel] + design.tau[design.channel] ** 2
    z = (mean - predicted) / np.sqrt(spread)
    new = rng.normal(size=z.shape)
    p_values, excess, warnings = {}, {}, []
    for c, name in enumerate(CHANNELS):
        chosen = there & (design.channel == c)
        if not chosen.any():
            continue
        observed, replicated = ((v[:, chosen] ** 2).sum(axis=1) for v in (z, new))
        p_values[name] = float(np.mean(replicated >= observed))
        excess[name] = float(np.median(design.tau[c] * np.exp(log_tau[:, c])))
        if p_values[name] < SMALL:
            warnings.append(f"{MEANING[name]} by more than sensor noise (p {p_values[name]:.3f})")
    return PredictiveCheck(p_values, excess, tuple(warnings))
