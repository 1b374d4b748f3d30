"""Emissions, boundary templates and transitions of a plain ordered task, and EM over its trials.

Emissions are independent Student t densities of the features. Neighbouring cells and correlated channels
repeat each other's evidence, so the log-likelihood is multiplied by `temper`, the share of independent
observations: the reciprocal integrated autocorrelation time of the residuals, times the effective over the
actual number of features (participation ratio of the eigenvalues of the residual correlation).

A labelled boundary often has a fixed lag to what the channels show. Each boundary therefore has a template:
the course of all channels in a window around it, less the window's mean. Its log-likelihood ratio against
windows anywhere adds to the log weight of advancing. It is invariant to time shifts.

Durations are geometric with a learned mean: memoryless, so that cropping the start does not matter, and wide,
so that time alone decides little. Optional states may be skipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmmseg.densities import log_student
from hmmseg.hmm import Chain, left_to_right
from hmmseg.hmm.inference import align
from hmmseg.hmm.results import AlignmentPosterior
from hmmseg.levels import TAIL

ONE_CELL = 1e-9  # numerics: weight [cells] below which a state is not updated
FLOORS = (1.0, 0.5, 0.25, 0.12, 0.06)  # numerics: least scale of an emission, lowered as EM converges
STEPS_PER_FLOOR = 4  # numerics: EM steps at each floor
LEAST_CELLS = 1.5  # numerics: least mean duration of a state


@dataclass(frozen=True)
class StudentEmissions:
    """`loc`, `scale` (num_states, num_features) of standardised features; `temper` in (0, 1]."""

    loc: np.ndarray
    scale: np.ndarray
    temper: float = 1.0

    def log_likelihoods(self, values: np.ndarray) -> np.ndarray:
        """Tempered log-likelihoods (num_cells, num_states); missing features contribute nothing."""
        return self.temper * log_student(values[:, None] - self.loc, self.scale).sum(axis=2)


def update(emissions: StudentEmissions, values: np.ndarray, weights: np.ndarray,
           floor: float) -> StudentEmissions:  # fmt: skip
    """One EM step for location and scale (Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 1989). `values`
    (num_cells, num_features) of all trials; `weights` (num_cells, num_states): posterior state probabilities;
    scales are at least `floor`."""
    loc, scale = emissions.loc.copy(), emissions.scale.copy()
    known = np.isfinite(values)
    x = np.where(known, values, 0.0)
    for k in range(len(loc)):
        gamma = weights[:, k, None] * known
        u = gamma * (TAIL + 1) / (TAIL + ((x - loc[k]) / scale[k]) ** 2)
        enough = (total := gamma.sum(0)) > ONE_CELL
        loc[k, enough] = ((u * x).sum(0)[enough]) / u.sum(0)[enough]
        spread = (u * (x - loc[k]) ** 2).sum(0)[enough] / total[enough]
        scale[k, enough] = np.sqrt(spread)
    return StudentEmissions(loc, np.maximum(scale, floor), emissions.temper)


def from_weights(values: np.ndarray, weights: np.ndarray, floor: float, temper: float,
                 iterations: int = 10) -> StudentEmissions:  # fmt: skip
    """Emissions for given posterior state probabilities: EM from their weighted moments."""
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
    """Independent observations per cell in residuals [(num_cells, num_features), ...]."""
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
    """Integrated autocorrelation time [cells], pooled over features, up to the first lag below 0.05."""
    x = r - r.mean(0)
    n = len(x)
    transform = np.fft.rfft(x, 2 * n, axis=0)
    covariance = np.fft.irfft(np.abs(transform) ** 2, axis=0)[: n // 2].sum(1)
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    end = int(np.argmax(rho < 0.05)) or len(rho)
    return float(1 + 2 * rho[1:end].sum())


PRIOR_COUNT = 2.0  # prior: weight of a channel's pooled spread against the spread at each lag
LEAST_SPREAD = 0.05  # chosen: share of a window's usual spread; labels align no better than that


@dataclass(frozen=True)
class Detectors:
    """Templates of all boundaries; windows have `2 * half` cells."""

    half: int
    mean: np.ndarray  # (num_boundaries, 2 * half, num_channels) of the template
    spread: np.ndarray  # the same
    usual: np.ndarray  # (num_channels,) spread of windows anywhere
    jitter: np.ndarray  # (num_boundaries,) [cells] scatter of held-out labels in excess of their posterior
    weight: float = 0.0  # of the log-likelihood ratio, as neighbouring cells and channels are dependent
    state_weight: float = 1.0  # of the emissions' log-likelihoods next to it

    def crossing(self, values: np.ndarray) -> np.ndarray:
        """Log weights (num_cells - 1, num_boundaries) of crossing, from the features of a trial."""
        return self.weight * self.log_ratios(values[:, : self.mean.shape[2]])

    def log_ratios(self, values: np.ndarray) -> np.ndarray:
        """Log-likelihood ratios (num_cells - 1, num_boundaries), before weighting, at each cell edge."""
        windows = _windows(values, self.half)
        log_far = log_student(windows, self.usual)
        return np.stack([
            (log_student(windows - mean, spread) - log_far).sum(axis=(1, 2))
            for mean, spread in zip(self.mean, self.spread, strict=True)
        ], axis=1)  # fmt: skip


def _windows(values: np.ndarray, half: int) -> np.ndarray:
    """Windows (num_cells - 1, 2 * half, num_channels) around each edge, less their mean; NaN outside."""
    gap = np.full((half - 1, values.shape[1]), np.nan)
    padded = np.concatenate([gap, values, gap])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half, axis=0).swapaxes(1, 2)
    known = np.isfinite(windows)
    mean = np.where(known, windows, 0.0).sum(1) / np.maximum(known.sum(1), 1)
    return windows - mean[:, None]


def learn(trials: Sequence[np.ndarray], edges: Sequence[np.ndarray], half: int) -> Detectors:
    """Templates from channels [(num_cells, num_channels), ...] and labelled edges. `edges[i][b]`: the cell
    before boundary b of trial i; -1 where the boundary has no course of its own (a skipped subtask). A
    boundary that no trial has gets ratio 0 everywhere."""
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
    """Chain of mean durations [cells], with the probabilities that optional states occur."""
    there = np.where(np.asarray(optional, bool), np.clip(presence, 1e-12, 1 - 1e-12), 1.0)
    return left_to_right(np.maximum(mean_cells, LEAST_CELLS), there)


def add_detectors(chain: Chain, crossing: np.ndarray) -> Chain:
    """The chain with log weights (num_cells - 1, num_boundaries) of crossing, both of a skipped state."""
    total = np.pad(np.cumsum(crossing, axis=1), ((0, 0), (1, 0)))
    stay, *jumps = chain.bands
    advance, *skips = (band + total[:, d:] - total[:, :-d] for d, band in enumerate(jumps, 1))
    ends = {"log_initial": chain.log_initial, "log_final": chain.log_final}
    return Chain(stay, advance, skips or None, **ends)


@dataclass
class Learner:
    """EM over the features of all trials."""

    values: list[np.ndarray]  # [(num_cells, num_features), ...], NaN where missing
    names: Sequence[str]  # of the task's states; states of one name share emissions
    optional: Sequence[bool]  # (num_states,) whether a state may be skipped
    known: list[np.ndarray | None] = field(default_factory=list)  # fixed path of each fully labelled trial
    # (num_cells, num_states), -inf where labels forbid a state and 0 elsewhere; None without any
    allowed: list[np.ndarray | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.known = self.known or [None] * len(self.values)
        self.allowed = self.allowed or [None] * len(self.values)
        self.num_states, self.stacked = len(self.optional), np.vstack(self.values)
        # States of one name are one state that recurs: their emissions are learned together.
        ids = [*self.names, *range(self.num_states - len(self.names))]
        self._same = np.array([[one == other for other in ids] for one in ids], dtype=float)

    def law(self, probability: Sequence[np.ndarray]) -> Chain:
        """Transitions, from posterior state probabilities."""
        return transitions(*durations(probability), self.optional)

    def emissions(self, probability: Sequence[np.ndarray], floor: float, temper: float) -> StudentEmissions:
        """Emissions, from posterior state probabilities alone."""
        return from_weights(self.stacked, np.vstack(probability) @ self._same, floor, temper)

    def align(self, emissions: StudentEmissions, law: Chain,
              detectors: Detectors | None = None) -> list[AlignmentPosterior]:  # fmt: skip
        """Posterior alignments of all trials, within what labels allow."""
        tables, chains = zip(*(weigh(v, emissions, law, detectors) for v in self.values), strict=True)
        tables = [ll if free is None else ll + free for ll, free in zip(tables, self.allowed, strict=True)]
        return align(tables, chains)

    def run(self, probability: Sequence[np.ndarray], temper: float, floors: Sequence[float] = FLOORS,
            detectors: Detectors | None = None, steps: int = STEPS_PER_FLOOR,
            ) -> tuple[StudentEmissions, list[np.ndarray]]:  # fmt: skip
        """EM from given state probabilities, `steps` at each scale floor; emissions and probabilities."""
        emissions, law = self.emissions(probability, floors[0], temper), self.law(probability)
        for floor in np.repeat(floors, steps):
            probability = self.labelled([each.smoothed for each in self.align(emissions, law, detectors)])
            emissions = update(emissions, self.stacked, np.vstack(probability) @ self._same, floor)
            law = self.law(probability)
        return emissions, list(probability)

    def labelled(self, probability: Sequence[np.ndarray]) -> list[np.ndarray]:
        """State probabilities, replaced by the labels of fully labelled trials."""
        return [p if k is None else np.eye(self.num_states)[k]
                for p, k in zip(probability, self.known, strict=True)]  # fmt: skip

    def tempered(self, emissions: StudentEmissions, probability: Sequence[np.ndarray]) -> StudentEmissions:
        """The emissions, tempered by the share of independent observations in their residuals."""
        residuals = []
        for values, path in zip(self.values, (p.argmax(1) for p in probability), strict=True):
            z = (values - emissions.loc[path]) / emissions.scale[path]
            residuals.append(np.arctan(np.nan_to_num(z)))  # bounds heavy tails
        return replace(emissions, temper=independent_share(residuals))


def weigh(values: np.ndarray, emissions: StudentEmissions, law: Chain,
            detectors: Detectors | None) -> tuple[np.ndarray, Chain]:  # fmt: skip
    """Log-likelihoods (num_cells, num_states) of a trial, and its chain."""
    ll = emissions.log_likelihoods(values)
    if detectors is None:
        return ll, law
    return detectors.state_weight * ll, add_detectors(law, detectors.crossing(values))


def durations(probability: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean durations [cells] and presence (num_states,), with a Beta(1, 1) prior, from posteriors."""
    visited = np.array([p.max(0) for p in probability])
    cells = np.sum([p.sum(0) for p in probability], 0) / np.maximum(visited.sum(0), 0.5)
    return np.maximum(cells, LEAST_CELLS), (visited.sum(0) + 1) / (len(probability) + 2)
