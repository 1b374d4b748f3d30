"""What the functions of hmmseg.hmm return: pytrees of NumPy arrays, of JAX arrays under jit and vmap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.tree_util import register_dataclass


def crossings(moves: Sequence[Any]) -> Any:
    """Probabilities that each boundary is crossed, from those of moves by one state, two, ..."""
    if len(moves) == 1:
        return moves[0]
    xp = np if isinstance(moves[0], np.ndarray) else _jax_numpy()
    width, crossed = moves[0].shape[1], 0.0
    for d, band in enumerate(moves, 1):
        for by in range(min(d, width)):  # a move by d states from k crosses the boundaries k to k + d - 1
            crossed = crossed + xp.pad(band, ((0, 0), (by, width - by - band.shape[1])))
    return crossed


def _jax_numpy() -> Any:
    import jax.numpy

    return jax.numpy


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

    def start_intervals(self, level: float = 0.9) -> np.ndarray:
        """Central credible interval [samples] of each boundary, as its first sample (num_states - 1, 2).

        NaN for a boundary that the posterior never crosses.
        """
        boundary, ends = np.asarray(self.boundary), np.array([1 - level, 1 + level]) / 2
        found = np.full((boundary.shape[1], 2), np.nan)
        for k, probability in enumerate(boundary.T):
            cumulative = np.cumsum(probability)
            if cumulative.size and cumulative[-1] > 0:
                found[k] = 1.0 + np.searchsorted(cumulative, ends * cumulative[-1])
        return found


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
