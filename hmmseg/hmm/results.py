"""Results of hmmseg.hmm's functions: pytrees of NumPy arrays, or of JAX arrays under jit and vmap."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.tree_util import register_dataclass


def crossings(moves: Sequence[Any]) -> Any:
    """Probability that each boundary is crossed, given the probabilities of moves by one state, two, ..."""
    if len(moves) == 1:
        return moves[0]
    xp = np if isinstance(moves[0], np.ndarray) else importlib.import_module("jax.numpy")
    width, crossed = moves[0].shape[1], 0.0
    for d, band in enumerate(moves, 1):
        for by in range(min(d, width)):  # a move by d states from k crosses boundaries k to k + d - 1
            crossed = crossed + xp.pad(band, ((0, 0), (by, width - by - band.shape[1])))
    return crossed


@register_dataclass
@dataclass(frozen=True)
class Alignment:
    """One path through the states, given by the start of each state.

    Attributes:
        starts: (num_states,), first sample of each state; a state that is not visited starts where the next
            one does (`num_samples` if none follows).
        num_samples: of the recording.
        log_prob: log weight of the path; under jit -inf if there is no path.
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
    """Several paths; `alignments[i]` is an Alignment.

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
    """Filtered probabilities.

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
        smoothed: [t, k], of state k at sample t.
        moves: moves[d - 1] [t, k], of moving from k to k + d between samples t and t + 1.
    """

    log_evidence: Any
    smoothed: Any
    moves: tuple[Any, ...]

    @property
    def boundary(self) -> Any:
        """Probability [t, k] that states up to k end between t and t + 1 (num_samples - 1, num_states - 1).

        A path that skips states crosses all their boundaries at once.
        """
        return crossings(self.moves)

    def start_intervals(self, level: float = 0.9) -> np.ndarray:
        """Central credible intervals (num_states - 1, 2) of the first sample of states 1, 2, ...

        Given that the state starts; NaN for a boundary that the posterior never crosses.
        """
        boundary, quantiles = np.asarray(self.boundary), np.array([1 - level, 1 + level]) / 2
        intervals = np.full((boundary.shape[1], 2), np.nan)
        for k, probability in enumerate(boundary.T):
            cumulative = np.cumsum(probability)
            if cumulative.size and cumulative[-1] > 0:
                intervals[k] = 1.0 + np.searchsorted(cumulative, quantiles * cumulative[-1])
        return intervals


@register_dataclass
@dataclass(frozen=True)
class AlignmentPosterior(Posterior):
    """A posterior with its most probable path.

    Attributes:
        path: (num_samples,), states of the most probable path.
        log_prob: its log weight.
    """

    path: Any
    log_prob: Any
