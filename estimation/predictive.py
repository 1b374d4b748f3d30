"""Posterior-predictive checks: could recordings like these come from the fitted model?

For each channel the discrepancy is the weighted scatter of the grips' means about their prediction,
with the scatter between grips at its prior median (it may not absorb what it is asked about): its
posterior-predictive p-value compares observed with replicated scatter (Gelman, Meng, Stern 1996). A
small p-value says that grips differ by more than sensors and hand explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation import priors
from estimation.density import NUM_CHANNELS
from estimation.observations import CHANNELS
from estimation.posterior import Posterior
from estimation.sampler import Draws

NUM_REPLICATES = 400  # numerics: tell a p-value of SMALL to 0.0035
SMALL = 0.005  # chosen: p-value from which a check warns; a result has up to a dozen of them
MEANING = {
    "force": "the net vertical force while carried differs between grips",
    "distance": "the distance of the fingers while held differs between grips",
    "rise": "the height by which a block rises or sinks differs between trials (slip in the grip does that)",
}


@dataclass(frozen=True)
class PredictiveCheck:
    """Posterior-predictive p-value per channel, and warnings for those that are small.

    `excess`: sd between grips beyond the sensors' noise, posterior median, per channel (N, m, m);
    `repeats`: observations that tell it, none where the prior alone decides.
    """

    p_values: dict[str, float]
    excess: dict[str, float]
    repeats: dict[str, int]
    warnings: tuple[str, ...]

    def to_json(self) -> dict:
        """p-values, excess scatter and what it was learned from, by channel."""
        return {
            name: {"p_value": p, "scatter_between_grips": self.excess[name], "repeats": self.repeats[name]}
            for name, p in self.p_values.items()
        }


def check(post: Posterior, draws: Draws, rng: np.random.Generator) -> PredictiveCheck:
    """Check every channel that was observed."""
    d = post.design

    def of(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(draws.flat), values.shape[-1])[chosen]

    chosen = rng.integers(len(draws.flat), size=NUM_REPLICATES)
    scales, shares = of(draws.scales), of(draws.shares)
    predicted = of(draws.chain) @ d.coefficients.T + of(draws.deviations) @ d.shifts.T
    predicted += shares[:, d.channel] * d.unit
    variance = d.variance * np.exp(2 * scales[:, d.channel])
    variance += (priors.SCATTER_MEDIAN[d.channel] * d.unit) ** 2
    z = (d.mean - predicted) / np.sqrt(variance)
    new = rng.normal(size=z.shape)
    p_values, excess, repeats, warnings = {}, {}, {}, []
    for c, name in enumerate(CHANNELS):
        mine = (d.channel == c) & ~d.slope
        if not mine.any():
            continue
        observed, replicated = ((v[:, mine] ** 2).sum(axis=1) for v in (z, new))
        p_values[name] = float(np.mean(replicated >= observed))
        share = priors.SCATTER_MEDIAN[c] * np.exp(scales[:, NUM_CHANNELS + c])
        excess[name] = float(np.median(share) * np.mean(np.abs(d.unit[mine])))
        repeats[name] = int(d.repeats()[c])
        if p_values[name] < SMALL:
            size = f"{excess[name]:.2g} N" if c == 0 else f"{1e6 * excess[name]:.2g} um"
            warnings.append(f"{MEANING[name]} by {size} beyond sensor noise; intervals allow for it")
    return PredictiveCheck(p_values, excess, repeats, tuple(warnings))
