"""What the functions of hmmseg.hmm return: pytrees of NumPy arrays, of JAX arrays under jit and vmap."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.tree_util import register_dataclass


def crossings(moves: Sequence[Any]) -> Any:
    """Probabilities that each boundary is crossed, from those of moves by one state, two, ..."""
    if len(moves) == 1:
        return moves[0]
    xp = np if isinstance(moves[0], np.ndarray) else importlib.import_module("jax.numpy")
    width, crossed = moves[0].shape[1], 0.0
    for d, band in enumerate(moves, 1):
        for by in range(min(d, width)):  # a move by d states from k crosses the boundaries k to k + d - 1
            crossed = crossed + xp.pad(band, ((0, 0), (by, width - by - band.shape[1])))
    return crossed


@register_dataclass
@dataclass(frozen=True)
class Alignment:
    """One path through the states, by where each state starts.

    Attributes:
        starts: (num_states,), first sample of each state; a state that is not visited starts where the
            next one does (`num_samples` where none follows).
        num_samples: of the recording.
        log_prob: the path's log weight; under jit -inf where there is no path.
    """

    starts: Any
    num_samples: Any
    log_prob: Any

    @property
    def lengths(self) -> np.ndarray:
        """Samples spent in each state (num_states,)."""
        return np.diff(self.starts, append=self.num_samples)

    @property
    def path(self) -> np.ndarray:
        """State of each sample (num_samples,)."""
        return np.repeat(np.arange(self.starts.size), self.lengths)


@register_dataclass
@dataclass(frozen=True)
class Alignments:
    """Several paths; `alignments[i]` is one of them.

    Attributes:
        starts: (n, num_states), num_samples (n,), log_prob (n,), as in Alignment.
    """

    starts: Any
    num_samples: Any
    log_prob: Any

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, i: int) -> Alignment:
        return Alignment(self.starts[i], int(self.num_samples[i]), float(self.log_prob[i]))

    def __iter__(self) -> Iterator[Alignment]:
        return (self[i] for i in range(len(self)))


@register_dataclass
@dataclass(frozen=True)
class Filtered:
    """On-line view.

    Attributes:
        log_evidence: log of the summed weight of all complete paths.
        filtered: [t, k] = p(state k at t | samples up to t).
    """

    log_evidence: Any
    filtered: Any


@register_dataclass
@dataclass(frozen=True)
class Posterior:
    """Posterior over alignments given the whole recording, as probabilities.

    Attributes:
        log_evidence: log of the summed weight of all paths.
        smoothed: [t, k], state k at sample t.
        moves: moves[d - 1] [t, k], from k to k + d between the samples t and t + 1.
    """

    log_evidence: Any
    smoothed: Any
    moves: tuple

    @property
    def boundary(self) -> Any:
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
        boundary = np.asarray(self.boundary)
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


@register_dataclass
@dataclass(frozen=True)
class AlignmentPosterior(Posterior):
    """A posterior with its most probable path.

    Attributes:
        path: (num_samples,), the states of the most probable path.
        log_prob: its log weight.
    """

    path: Any
    log_prob: Any
