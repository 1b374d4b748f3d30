"""Posterior of the largest true ratio among many noisy ones.

The largest of noisy ratios exceeds the largest true one, the more so the more samples there are.
So the ratios' own distribution G is learned with them: true ratios are independent draws of G,
G has a Dirichlet prior over bins (Ferguson, Ann. Stat. 1, 1973), and each measured ratio is its
true one plus Gaussian noise. Samples at a common limit then share an atom of G instead of
scattering about it. Gibbs sweeps (Escobar & West, JASA 90, 1995) alternate between G and the
samples' bins; given G, the distribution function of the maximum is the product of the samples'.
"""

from __future__ import annotations

import numpy as np

CONCENTRATION = 1.0  # prior: weight of G, in samples
BINS_PER_SD = 3.0  # numerics: bins of G to the smallest noise
MAX_BINS = 300  # numerics: of G at most: its cost is linear in them
GLITCH = 0.01  # prior: share of samples that say nothing: a bound must rest on more than one
BURN_IN, SWEEPS = 20, 48  # numerics: of Gibbs sampling: left out, and kept
CORROBORATING = 8  # chosen: samples of which surely not all are glitches
REACH = 5.0  # numerics: standard deviations beyond which a sample cannot be the largest


def largest_ratio(
    ratio: np.ndarray, sd: np.ndarray, held: np.ndarray, rng: np.random.Generator, num_draws: int
) -> np.ndarray:
    """Posterior draws (num_draws,) of the largest true ratio.

    `ratio`, `sd` (num_samples,): measured absolute ratios and their noise; `held`
    (num_alignments, num_samples): under which drawn alignment each sample counts. Alignments are
    marginalised in the maximum; G is learned from the samples of all of them.
    """
    edges = _edges(ratio, sd)
    centres = (edges[1:] + edges[:-1]) / 2
    # A Dirichlet's upper part is independent of how its lower part is split: samples that cannot
    # be the largest enter by their number only.
    often = held.mean(axis=0)
    lower = np.sort(np.where(often == often.max(), ratio - REACH * sd, 0.0))
    cut = lower[-min(CORROBORATING, lower.size)]
    high = ratio + REACH * sd > cut
    top = centres > cut - REACH * sd[high].max()
    low_count = float((~high).sum()) + CONCENTRATION * float(np.mean(~top))
    prior = np.full(int(top.sum()), CONCENTRATION / centres.size)
    likelihood = _likelihood(ratio[high], sd[high], centres[top])
    log_likelihood = np.log(likelihood + 1e-300)
    glitch = GLITCH / (1 - GLITCH) / edges[-1]
    held = held[:, high]
    weights = np.full(prior.size, 1.0 / centres.size)
    cdf = np.zeros(prior.size)
    for sweep in range(BURN_IN + SWEEPS):
        shares = np.cumsum(likelihood * weights, axis=1)
        total = shares[:, -1] + glitch
        if sweep >= BURN_IN:
            log_below = np.log((shares + glitch) / total[:, None])
            cdf += np.exp(held @ log_below).mean(axis=0) / SWEEPS
        bins = (shares < (rng.uniform(size=total.size) * total)[:, None]).sum(axis=1)
        true = bins < prior.size
        counts = _moved(bins[true], log_likelihood[true], rng)
        weights = rng.standard_gamma(counts + prior)
        weights /= weights.sum() + rng.standard_gamma(low_count + 1e-9)
    levels = np.concatenate([[0.0], np.maximum.accumulate(cdf)])
    upper = edges[np.flatnonzero(top)[0] :]
    quantiles = (rng.permutation(num_draws) + rng.uniform(size=num_draws)) / num_draws
    return np.interp(quantiles * levels[-1], levels, upper)


def _edges(ratio: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Bins of G from 0 past the largest ratio."""
    end = float(np.max(ratio + REACH * sd))
    return np.linspace(0.0, end, int(np.clip(BINS_PER_SD * end / sd.min(), 20, MAX_BINS)) + 1)


def _likelihood(ratio: np.ndarray, sd: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Density (num_samples, num_bins) of measured absolute ratios given the true ones."""
    z = np.stack([ratio[:, None] - centres, ratio[:, None] + centres]) / sd[:, None]
    return np.exp(-0.5 * z**2).sum(axis=0) / (sd[:, None] * np.sqrt(2 * np.pi))


def _moved(bins: np.ndarray, log_likelihood: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples in each bin (num_bins,) once every atom has been drawn anew, its samples with it.

    Without this step an atom with many samples would never leave its bin.
    """
    atoms, member = np.unique(bins, return_inverse=True)
    joint = np.zeros((atoms.size, log_likelihood.shape[1]))
    np.add.at(joint, member, log_likelihood)
    places = np.argmax(joint + rng.gumbel(size=joint.shape), axis=1)
    sizes = np.bincount(member, minlength=atoms.size)
    return np.bincount(places, weights=sizes, minlength=log_likelihood.shape[1])
