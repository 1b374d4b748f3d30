"""The model of a plain ordered task, and its EM: what states and boundaries look like, how states follow.

States have independent Student t features, tempered for dependence: neighbouring cells and different
channels repeat each other's evidence, and multiplying their likelihoods as if independent would make
boundaries overconfident. So the log-likelihood is multiplied by `temper`, the share of independent
observations: one over the integrated autocorrelation time of the residuals, times the effective number of
features over their number (participation ratio of the residual correlation's eigenvalues).

A labelled boundary often lies at a fixed lag from what the channels show (a controller switches, contact
follows). For every boundary the course of all channels in a window around it, without the window's mean, is
compared with what such windows look like anywhere: a log-likelihood ratio per candidate time, added to the
log weight of advancing. Nothing in it knows the time of day or the time since the start.

Durations are geometric on the grid with a learned mean: the one law that a crop at the start does not
disturb, and a wide one, so that the clock does not decide. States may be skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import gammaln

from hmmseg.hmm import Chain, left_to_right
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior

DOF = 4.0  # cited: heavy tails: a transient moves neither location nor scale much
ONE_CELL = 1e-9  # numerics: a state without even so much weight is left as it is
FLOORS = (1.0, 0.5, 0.25, 0.12, 0.06)  # numerics: least scale of an emission, lowered as EM settles
STEPS_PER_FLOOR = 4  # numerics: of EM
LEAST_CELLS = 1.5  # numerics: least mean duration of a state


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


PRIOR_COUNT = 2.0  # prior: weight of the channel's own pooled spread against that of each lag
LEAST_SPREAD = 0.05  # chosen: of a window's usual spread: labels are no better aligned than that


@dataclass(frozen=True)
class Detectors:
    """Templates of all boundaries; windows have `2 * half` cells.

    `mean`, `spread` (num_boundaries, 2 * half, num_channels), `usual` (num_channels,) the spread of
    windows anywhere; `jitter` (num_boundaries,) [cells] how much more than their posterior says
    held-out labels scatter; `weight` multiplies the log-likelihood ratio (neighbouring cells and
    channels are not independent), `state_weight` the state emissions.
    """

    half: int
    mean: np.ndarray
    spread: np.ndarray
    usual: np.ndarray
    jitter: np.ndarray
    weight: float = 0.0
    state_weight: float = 1.0

    def crossing(self, values: np.ndarray) -> np.ndarray:
        """Log weights (num_cells - 1, num_boundaries) of crossing, from all features of a trial."""
        return self.weight * self.log_ratios(values[:, : self.mean.shape[2]])

    def log_ratios(self, values: np.ndarray) -> np.ndarray:
        """Unweighted log-likelihood ratios (num_cells - 1, num_boundaries), one a cell edge."""
        windows = _windows(values, self.half)
        log_far = _log_density(windows, self.usual)
        return np.stack([
            np.nansum(_log_density(windows - mean, spread) - log_far, axis=(1, 2))
            for mean, spread in zip(self.mean, self.spread, strict=True)
        ], axis=1)  # fmt: skip


def _log_density(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Student t, without its constant."""
    return -(DOF + 1) / 2 * np.log1p((x / scale) ** 2 / DOF) - np.log(scale)


def _windows(values: np.ndarray, half: int) -> np.ndarray:
    """Windows (num_cells - 1, 2 * half, num_channels) around every edge, mean removed; NaN outside."""
    gap = np.full((half - 1, values.shape[1]), np.nan)
    padded = np.concatenate([gap, values, gap])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half, axis=0).swapaxes(1, 2)
    known = np.isfinite(windows)
    mean = np.where(known, windows, 0.0).sum(1) / np.maximum(known.sum(1), 1)
    return windows - mean[:, None]


def learn(trials: Sequence[np.ndarray], edges: Sequence[np.ndarray], half: int) -> Detectors:
    """Templates from channels [(num_cells, num_channels), ...] and labelled edges.

    `edges[i][b]` is the index of the edge (between the cells of that index and the next) at
    boundary b of trial i; -1 where the boundary shows nothing of its own (a skipped subtask). A
    boundary that no trial shows has ratio 0 everywhere.
    """
    windows = [_windows(values, half) for values in trials]
    usual = np.sqrt(np.nanmean(np.vstack(windows) ** 2, axis=(0, 1)))
    usual = np.maximum(np.nan_to_num(usual), 1e-6)
    near = np.stack([w[np.clip(e, 0, len(w) - 1)] for w, e in zip(windows, edges, strict=True)])
    near[np.stack(edges) < 0] = np.nan
    known = np.isfinite(near)
    count = known.sum(0)
    filled = np.where(known, near, 0.0)
    mean = filled.sum(0) / np.maximum(count, 1)
    square = (known * (filled - mean) ** 2).sum(0)
    pooled = square.sum(1, keepdims=True) / np.maximum(count.sum(1, keepdims=True), 1)
    spread = (square + PRIOR_COUNT * pooled) / (count + PRIOR_COUNT) * (1 + 1 / np.maximum(count, 1))
    spread = np.where(count > 0, np.sqrt(spread) + LEAST_SPREAD * usual, usual)
    return Detectors(half, mean, spread, usual, np.zeros(len(mean)))


def transitions(mean_cells: np.ndarray, presence: np.ndarray, optional: Sequence[bool]) -> Chain:
    """The chain of mean durations [cells] and the probability that an optional state occurs."""
    there = np.where(np.asarray(optional, bool), np.clip(presence, 1e-12, 1 - 1e-12), 1.0)
    return left_to_right(np.maximum(mean_cells, LEAST_CELLS), there)


def detecting(chain: Chain, crossing: np.ndarray) -> Chain:
    """The chain with log weights (num_cells - 1, num_boundaries) of crossing each boundary.

    Who skips subtasks crosses their boundaries.
    """
    total = np.pad(np.cumsum(crossing, axis=1), ((0, 0), (1, 0)))
    stay, *jumps = chain.bands
    advance, *skips = (
        band + total[:, d:] - total[:, : total.shape[1] - d] for d, band in enumerate(jumps, 1)
    )
    ends = {"log_initial": chain.log_initial, "log_final": chain.log_final}
    return Chain(stay, advance, skips or None, **ends)


@dataclass
class Learner:
    """EM over `values` [(num_cells, num_features), ...] of all trials.

    `names` of the task's states and `optional` (num_states,) say what may follow what. What labels say of
    each trial: `known`, its path (num_cells,), which then stays as it is; `allowed` (num_cells, num_states),
    -inf where a state is forbidden and 0 elsewhere. None where they say nothing.
    """

    values: list[np.ndarray]
    names: Sequence[str]
    optional: Sequence[bool]
    known: list[np.ndarray | None] = field(default_factory=list)
    allowed: list[np.ndarray | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.known = self.known or [None] * len(self.values)
        self.allowed = self.allowed or [None] * len(self.values)
        self.num_states, self.stacked = len(self.optional), np.vstack(self.values)
        # A name listed twice is one state that comes twice: its emissions are learned together.
        ids = [*self.names, *range(self.num_states - len(self.names))]
        self._same = np.array([[one == other for other in ids] for one in ids], dtype=float)

    def law(self, probability: Sequence[np.ndarray]) -> Chain:
        """How states follow each other, from posterior state probabilities."""
        return transitions(*durations(probability), self.optional)

    def emissions(self, probability: Sequence[np.ndarray], floor: float, temper: float) -> StudentEmissions:
        """Emissions from posterior state probabilities alone."""
        return from_weights(self.stacked, np.vstack(probability) @ self._same, floor, temper)

    def align(self, emissions: StudentEmissions, law: Chain,
              detectors: Detectors | None = None) -> list[AlignmentPosterior]:  # fmt: skip
        """Alignments of all trials, in which no state is where labels forbid it."""
        tables, chains = zip(
            *(weighed(values, emissions, law, detectors) for values in self.values), strict=True
        )
        tables = [ll if free is None else ll + free for ll, free in zip(tables, self.allowed, strict=True)]
        return align(tables, chains)

    def run(self, probability: Sequence[np.ndarray], temper: float, floors: Sequence[float] = FLOORS,
            detectors: Detectors | None = None, steps: int = STEPS_PER_FLOOR,
            ) -> tuple[StudentEmissions, list[np.ndarray]]:  # fmt: skip
        """EM from given state probabilities, `steps` at each floor of the scales; also those it ends with."""
        emissions, law = self.emissions(probability, floors[0], temper), self.law(probability)
        for floor in np.repeat(floors, steps):
            probability = self.labelled([each.smoothed for each in self.align(emissions, law, detectors)])
            emissions = update(emissions, self.stacked, np.vstack(probability) @ self._same, floor)
            law = self.law(probability)
        return emissions, list(probability)

    def labelled(self, probability: Sequence[np.ndarray]) -> list[np.ndarray]:
        """State probabilities, of labelled trials those of their labels."""
        return [p if k is None else np.eye(self.num_states)[k]
                for p, k in zip(probability, self.known, strict=True)]  # fmt: skip

    def tempered(self, emissions: StudentEmissions, probability: Sequence[np.ndarray]) -> StudentEmissions:
        """Emissions with the share of independent observations in what they leave of the features."""
        left = []
        for values, path in zip(self.values, (p.argmax(1) for p in probability), strict=True):
            z = (values - emissions.loc[path]) / emissions.scale[path]
            left.append(np.arctan(np.nan_to_num(z)))  # heavy tails brought in
        return replace(emissions, temper=independent_share(left))


def weighed(values: np.ndarray, emissions: StudentEmissions, law: Chain,
            detectors: Detectors | None) -> tuple[np.ndarray, Chain]:  # fmt: skip
    """Log-likelihoods (num_cells, num_states) of a trial, and its chain."""
    ll = emissions.log_likelihoods(values)
    if detectors is None:
        return ll, law
    return detectors.state_weight * ll, detecting(law, detectors.crossing(values))


def durations(probability: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean durations [cells] and presence (num_states,), from posterior state probabilities.

    Presence has a Beta(1, 1) prior.
    """
    visited = np.array([p.max(0) for p in probability])
    cells = np.sum([p.sum(0) for p in probability], 0) / np.maximum(visited.sum(0), 0.5)
    return np.maximum(cells, LEAST_CELLS), (visited.sum(0) + 1) / (len(probability) + 2)
