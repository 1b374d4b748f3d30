"""Is there a gap and where: cells of the mean difference against the scatter between trials.

A cell's statistic is the mean over its features of (difference of means)² over its variance,
s_real² / R + s_sim² / S (Welch), each variance moderated towards the cell's mean, as few trials tell it
badly. Which value is too large is found by exchanging the labels real and simulated among the trials,
which leaves every dependence between cells in place (Westfall & Young, Resampling-Based Multiple
Testing, 1993): the largest score and the mean score, the smaller of their two ranks counting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import fdtrc, ndtr, ndtri

from simgap.generic.features import FAST, SLOW, Layout

PERMUTATIONS = 999  # numerics: of labels, at most
ENOUGH = 100  # numerics: different exchanges; with fewer the F distribution and Bonferroni's bound serve
MODERATION = 4.0  # prior: degrees of freedom that a cell's mean variance is worth
PACE = 0.02  # chosen: of a duration: clocks repeat themselves exactly, and nobody minds less
NOTHING = 1e-6  # numerics: of a channel's scale: no sd is smaller
CHUNK = 50  # numerics: exchanges at a time
LEVEL = 0.05  # chosen: family-wise, of the cells that are listed
Z_LARGEST = 37.0  # numerics: beyond, probabilities underflow


@dataclass(frozen=True)
class Located:
    """`z` (cells,): normal scores of the difference; `trial_z` (R, cells): of each real trial;
    `p_value` of any gap; `threshold`: score that a healthy comparison reaches in 5 %;
    `exchanges` of labels that this rests on, 0 where there are too few to make.
    """

    z: np.ndarray
    trial_z: np.ndarray
    p_value: float
    threshold: float
    exchanges: int

    @property
    def resolution(self) -> float:
        """The smallest p-value that so many exchanges can show; 0 where none were made."""
        return 1 / (self.exchanges + 1) if self.exchanges else 0.0


def variances(given: Layout, values: np.ndarray) -> np.ndarray:
    """Moderated variances between trials (F,) of features (n, F); NaN for a single trial."""
    n = len(values)
    if n < 2:
        return np.full(values.shape[1], np.nan)
    return _moderated(given, values.var(0, ddof=1), n)


def _moderated(given: Layout, raw: np.ndarray, n: int) -> np.ndarray:
    """Variances (..., F) of n trials drawn towards the mean of their cell."""
    pooled = cell_means(given, raw)[..., given.cell]
    return np.maximum(((n - 1) * raw + MODERATION * pooled) / (n - 1 + MODERATION), _least(given))


def _least(given: Layout) -> np.ndarray:
    """Least variance (F,): the log of a mean of m squares of noise has 2 / m, of which half is kept."""
    scale = np.where(given.channel >= 0, given.scale[given.channel], 1.0)
    return np.where(
        given.kind == SLOW, (NOTHING * scale) ** 2, np.where(given.kind == FAST, 1 / given.width, PACE**2)
    )


def both_variances(given: Layout, real: np.ndarray, sim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances between real and between simulated trials; a single trial borrows the other kind's."""
    a, b = variances(given, real), variances(given, sim)
    return np.where(np.isfinite(a), a, b), np.where(np.isfinite(b), b, a)


def independent(given: Layout, real: np.ndarray, sim: np.ndarray) -> np.ndarray:
    """How many independent features each cell is worth (cells,): n / (1 + (n - 1) mean r²).

    Correlations r between trials' deviations from their own kind's mean; what chance adds to r² is
    taken off (Satterthwaite's argument: Biometrics Bulletin 2, 1946).
    """
    deviations = np.vstack([real - real.mean(0), sim - sim.mean(0)])
    dof = max(len(deviations) - 2, 1)
    out = np.ones(len(given.cells))
    for k, n in enumerate(np.bincount(given.cell)):
        x = deviations[:, given.cell == k]
        size = np.sqrt((x**2).sum(0))
        r = x.T @ x / np.maximum(np.outer(size, size), 1e-300)
        if n > 1:
            square = ((r**2).sum() - n) / (n * (n - 1))
            square = np.clip((square - 1 / dof) / (1 - 1 / (dof + 1)), 0.0, 1.0)
            out[k] = n / (1 + (n - 1) * square)
    return out


def scores(given: Layout, real: np.ndarray, sim: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Normal scores (cells,) of the difference between the means."""
    a, b = both_variances(given, real, sim)
    ratio = (real.mean(0) - sim.mean(0)) ** 2 / (a / len(real) + b / len(sim))
    return _normal(given, ratio, len(real) + len(sim) - 2, first)


def trial_scores(given: Layout, real: np.ndarray, sim: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Normal scores (R, cells) of each real trial against the simulated ones."""
    a, b = both_variances(given, real, sim)
    ratio = (real - sim.mean(0)) ** 2 / (a + b / len(sim))
    return _normal(given, ratio, len(real) + len(sim) - 2, first)


def cell_means(given: Layout, values: np.ndarray) -> np.ndarray:
    """Means (..., cells) of features (..., F), whose cells lie side by side."""
    starts = np.flatnonzero(np.diff(given.cell, prepend=-1))
    return np.add.reduceat(values, starts, axis=-1) / np.bincount(given.cell)


def _normal(given: Layout, ratio: np.ndarray, dof: float, first: np.ndarray) -> np.ndarray:
    """Mean squared ratios of cells as normal scores; `first` (cells,): independent features of each."""
    above = fdtrc(first, first * (dof + MODERATION), cell_means(given, ratio))
    return np.clip(-ndtri(above), -Z_LARGEST, Z_LARGEST)


def locate(given: Layout, real: np.ndarray, sim: np.ndarray, seed: int = 0) -> Located:
    """Scores of all cells and what they are worth."""
    first = independent(given, real, sim)
    z, trial_z = scores(given, real, sim, first), trial_scores(given, real, sim, first)
    everything, count = np.concatenate([real, sim]), len(real)
    exchanges = _exchanges(len(everything), count, seed)
    if exchanges is None:
        p = min(1.0, float(ndtr(-z.max())) * z.size)
        return Located(z, trial_z, p, -float(ndtri(LEVEL / z.size)), 0)
    null = _exchanged(given, everything, count, exchanges, first)
    both = np.vstack([[z.max(), z.mean()], null])
    # Share of exchanges at least as large, for either statistic; the smaller one counts.
    ranks = np.array([(both[:, k][None] >= both[:, k][:, None]).mean(1) for k in range(2)]).min(0)
    p = float((ranks <= ranks[0]).mean())
    return Located(z, trial_z, p, float(np.quantile(null[:, 0], 1 - LEVEL)), len(exchanges))


def _exchanged(
    given: Layout, everything: np.ndarray, count: int, exchanges: list[tuple[int, ...]], first: np.ndarray
) -> np.ndarray:
    """Largest and mean score of every exchange (P, 2)."""
    x = everything - everything.mean(0)
    n, dof = len(x), len(x) - 2
    null = np.zeros((len(exchanges), 2))
    for start in range(0, len(exchanges), CHUNK):
        chosen = exchanges[start : start + CHUNK]
        there = np.zeros((len(chosen), n))
        for row, members in zip(there, chosen, strict=True):
            row[list(members)] = 1.0
        mean, variance = [], []
        for mask, size in ((there, count), (1 - there, n - count)):
            m = mask @ x / size
            raw = np.maximum(mask @ x**2 / size - m**2, 0.0) * size / max(size - 1, 1)
            mean.append(m)
            variance.append(_moderated(given, raw, size) if size > 1 else None)
        a, b = (v if v is not None else variance[1 - k] for k, v in enumerate(variance))
        z = _normal(given, (mean[0] - mean[1]) ** 2 / (a + b * count / (n - count)) * count, dof, first)
        null[start : start + len(chosen)] = np.stack([z.max(1), z.mean(1)], 1)
    return null


def _exchanges(total: int, count: int, seed: int) -> list[tuple[int, ...]] | None:
    """Other choices of `count` trials to be called real; None where there are too few of them."""
    number = math.comb(total, count)
    if number < ENOUGH:
        return None
    original = tuple(range(count))
    if number <= PERMUTATIONS:
        return [c for c in combinations(range(total), count) if c != original]
    rng = np.random.default_rng(seed)
    return [tuple(rng.permutation(total)[:count].tolist()) for _ in range(PERMUTATIONS)]
