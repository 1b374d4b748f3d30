"""Simulation-based calibration: true values rank uniformly among the draws (Talts et al. 2018)."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_scene import SD, make_design
from scipy.stats import chisquare

from estimation import priors
from estimation.mode import find_mode
from estimation.posterior import pack
from estimation.sampler import sample

REPLICATES, KEPT = 160, 15  # ranks 0 to 15: 16 cells of ten on average


def from_the_prior(seed):
    """A design whose data are drawn from the model, every parameter from its prior."""
    rng = np.random.default_rng(seed)
    design = make_design(deviations=2)
    mean, sd = priors.property_priors(design.names)
    # Properties come from a tenth of the prior's width: the likelihood is a thousandth of it.
    log_properties = mean + 0.1 * sd * rng.normal(size=3)
    scale = np.exp(rng.normal(size=3) / np.sqrt(2 * design.scale_count))
    tau = design.tau * np.exp(priors.TAU_LOG_SD * rng.normal(size=3))
    common, size = design.common * rng.normal(size=3), rng.normal(size=2)
    noise = scale * SD * rng.normal(size=(4, 1, 3)) + tau * rng.normal(size=(4, 1, 3))
    recorded = design.coefficients @ np.exp(log_properties) + design.shifts @ size + common + noise
    free = design.free_shifts @ size + np.sqrt(design.free_variance) * rng.normal(size=(4, 4))
    return replace(design, mean=recorded, free_mean=free), log_properties, size


@pytest.mark.slow
def test_true_values_rank_uniformly():
    ranks = []
    for seed in range(REPLICATES):
        design, log_properties, size = from_the_prior(seed)
        start = np.concatenate([log_properties + 0.02, np.zeros(9 + 2)])
        draws = sample(find_mode(start, pack(design)), seed).flat
        kept = draws[np.random.default_rng(seed).choice(len(draws), KEPT, replace=False)]
        true = np.concatenate([log_properties, size])
        ranks.append((kept[:, [0, 1, 2, 12, 13]] < true).sum(axis=0))
    for column in np.array(ranks).T:
        counts = np.bincount(column, minlength=KEPT + 1)
        assert chisquare(counts).pvalue > 1e-3, counts
