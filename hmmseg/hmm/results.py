"""What the recursions of hmmseg.hmm return."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np


def crossings(moves: Sequence[np.ndarray]) -> np.ndarray:
    """Probabilities that each boundary is crossed, from those of moves by one state, two, ..."""
    if len(moves) == 1:
        return moves[0]
    crossed = moves[0].copy()
    for d, band in enumerate(moves[1:], 2):
        for k in range(band.shape[1]):
            crossed[:, k : k + d] += band[:, k, None]
    return crossed


@dataclass(frozen=True)
class Alignment:
    """One path through the states, by where each state starts.

    `starts` (num_states,): first sample of each state; a state that is not visited starts where the
    next one does (`num_samples` where none follows). `log_prob`: the path's log weight.
    """

    starts: np.ndarray
    num_samples: int
    log_prob: float

    @property
    def lengths(self) -> np.ndarray:
        """Samples spent in each state (num_states,)."""
        return np.diff(self.starts, append=self.num_samples)

    @property
    def path(self) -> np.ndarray:
        """State of each sample (num_samples,)."""
        return np.repeat(np.arange(self.starts.size), self.lengths)


@dataclass(frozen=True)
class Alignments:
    """Several paths; `alignments[i]` is one of them.

    `starts` (n, num_states), `num_samples` (n,), `log_prob` (n,), as in Alignment.
    """

    starts: np.ndarray
    num_samples: np.ndarray
    log_prob: np.ndarray

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, i: int) -> Alignment:
        return Alignment(self.starts[i], int(self.num_samples[i]), float(self.log_prob[i]))

    def __iter__(self) -> Iterator[Alignment]:
        return (self[i] for i in range(len(self)))


@dataclass(frozen=True)
class Filtered:
    """On-line view: `filtered` [t, k] = p(state k at t | samples up to t).

    `log_evidence` sums the weights of all complete paths.
    """

    log_evidence: float
    filtered: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """Posterior over alignments given the whole recording, as probabilities.

    `smoothed` [t, k]: state k at sample t. `moves[d - 1]` [t, k]: from k to k + d between the
    samples t and t + 1.
    """

    log_evidence: float
    smoothed: np.ndarray
    moves: tuple[np.ndarray, ...]

    @property
    def boundary(self) -> np.ndarray:
        """Probability [t, k] that states up to k end between t and t + 1 (num_samples - 1, num_states - 1).

        Who passes over states crosses all their boundaries at once.
        """
        return crossings(self.moves)

    def start_quantiles(self, q: float) -> np.ndarray:
        """Quantile of the first sample of the states 1, 2, ... (num_states - 1,), given that they start.

        NaN for a boundary that the posterior never crosses.
        """
        return self._quantiles(q)[:, 0]

    def start_intervals(self, level: float = 0.9) -> np.ndarray:
        """Central credible interval [samples] of each boundary, as its first sample (num_states - 1, 2)."""
        return self._quantiles((1 - level) / 2, (1 + level) / 2)

    def _quantiles(self, *levels: float) -> np.ndarray:
        boundary = self.boundary
        found = np.full((boundary.shape[1], len(levels)), np.nan)
        for k, probability in enumerate(boundary.T):
            cumulative = np.cumsum(probability)
            if cumulative.size and cumulative[-1] > 0:
                found[k] = 1.0 + np.searchsorted(cumulative, np.array(levels) * cumulative[-1])
        return found

    def confidence(self, alignment: Alignment, within: int = 0) -> np.ndarray:
        """Probability (num_states - 1,) that each boundary of an alignment is right to `within` samples."""
        cumulative = np.pad(np.cumsum(self.boundary, axis=0), ((1, 0), (0, 0)))
        at = alignment.starts[1:] - 1  # the interval between two samples in which the boundary lies
        low = np.clip(at - within, 0, len(cumulative) - 1)
        high = np.clip(at + within + 1, 0, len(cumulative) - 1)
        k = np.arange(cumulative.shape[1])
        return cumulative[high, k] - cumulative[low, k]
