"""The posterior of a stream: filtered at once, smoothed after a fixed lag.

Memory and time per sample are O(num_states lag), however long the stream is; each sample is one call of a
compiled program.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from hmmseg.hmm.chain import Chain, InfeasibleAlignment
from hmmseg.hmm.durations import DurationChain
from hmmseg.hmm.recursions import forwards, log_add, log_sum, smooth
from hmmseg.hmm.results import crossings


@dataclass(frozen=True)
class Step:
    """Posterior after one more sample.

    Attributes:
        sample: its number.
        filtered: (num_states,), probability of each state at it.
        log_evidence: log weight of all paths so far, wherever they are.
        smoothed: (num_states,), probability of each state `lag` samples earlier; None for the first samples.
        boundary: (num_states - 1,), probability that states up to k ended right before that sample.
    """

    sample: int
    filtered: np.ndarray
    log_evidence: float
    smoothed: np.ndarray | None
    boundary: np.ndarray | None


@dataclass(frozen=True)
class Window:
    """Samples `first`, first + 1, ... given everything received.

    Attributes:
        first: number of the first sample.
        smoothed: (n, num_states).
        boundary: (n, num_states - 1), probability that states up to k ended right before each sample (zeros
            for sample 0).
    """

    first: int
    smoothed: np.ndarray
    boundary: np.ndarray


class StreamingFilter:
    """Follows a stream through a chain with constant weights.

    Args:
        chain: without duration tables, which would need the whole stream.
        lag: samples by which smoothing is delayed (0: no smoothing). Boundary posteriors summed over time are
            those of fixed-lag smoothing.

    Raises:
        ValueError: a chain that varies in time, a negative lag.
    """

    def __init__(self, chain: Chain | DurationChain, lag: int) -> None:
        if not isinstance(chain, Chain):
            raise ValueError("chain: tables of durations, expected a Chain: they would need the whole stream")
        if chain.num_samples is not None:
            raise ValueError("chain: varies in time, expected one that does not: streams have no known end")
        if lag < 0:
            raise ValueError(f"lag: {lag}, expected 0 or more samples")
        self.chain, self.lag = chain, lag
        self.num_samples = 0
        self._w = chain.by_target()
        # Log filtered probabilities of the last lag + 2 samples, the newest last.
        self._before = np.full((lag + 2, chain.num_states), -np.inf)
        self._log_evidence = 0.0

    def update(self, log_likelihood: ArrayLike) -> Step:
        """Process one sample's log-likelihoods (num_states,); NaN throughout: a missing sample.

        Raises InfeasibleAlignment if no state remains possible, ValueError for NaN beside numbers and for
        +inf; the stream is then unchanged.
        """
        row, k = np.asarray(log_likelihood, dtype=np.float64), self.chain.num_states
        if row.shape != (k,):
            raise ValueError(f"log_likelihood: shape {row.shape}, expected {(k,)}")
        missing = np.isnan(row)
        row = np.zeros(k) if missing.all() else row
        if (missing.any() and not missing.all()) or np.isposinf(row).any():
            found = f"log_likelihood: {row.tolist()}"
            raise ValueError(f"{found}, expected numbers or -inf (missing: NaN throughout)")
        first = np.asarray(self.chain.log_initial) if self.num_samples == 0 else np.full(k, -np.inf)
        with jax.enable_x64(True):
            before, gained, *smoothed = jax.tree.map(np.asarray, _update(self._before, self._w, first, row))
        if not math.isfinite(gained):
            reached = np.flatnonzero(np.isfinite(self._before[-1])).max(initial=-1)
            why = f"no state is possible at sample {self.num_samples}"
            raise InfeasibleAlignment(min(int(reached) + 1, k - 1), why)
        self._before = before
        self._log_evidence += float(gained)
        sample, self.num_samples = self.num_samples, self.num_samples + 1
        late = (None, None) if sample < self.lag else (smoothed[0][1], smoothed[1][0])
        return Step(sample, np.exp(before[-1]), self._log_evidence, *late)

    def window(self) -> Window:
        """The last lag + 1 samples given everything received, whether or not more follows."""
        return self._window(self.lag + 1, np.zeros(self.chain.num_states))

    def finish(self) -> Window:
        """The samples that no step has smoothed, given the whole stream and the final weights of the chain.

        Raises InfeasibleAlignment if the chain cannot end there.
        """
        return self._window(self.lag, np.asarray(self.chain.log_final))

    def _window(self, most: int, final: np.ndarray) -> Window:
        if self.num_samples == 0:
            raise ValueError("stream: no sample has come, expected at least one")
        if not np.isfinite(self._before[-1] + final).any():
            raise InfeasibleAlignment(self.chain.num_states - 1, "reached, but cannot be held to the end")
        num = min(most, self.num_samples)
        with jax.enable_x64(True):
            smoothed, boundary = map(np.asarray, _smooth(self._before, self._w, final))
        at = len(smoothed) - num
        return Window(self.num_samples - num, smoothed[at:], boundary[at - 1 : len(boundary)])


@jax.jit
def _smooth(before: Array, w: Array, final: Array) -> tuple[Array, Array]:
    """Probabilities of the window's states, and of the boundaries between its samples."""
    states, moves = smooth(before, w, final, jnp.int32(len(before)), False)
    return states, crossings([moves[:, d, d:] for d in range(1, w.shape[1])])


@jax.jit
def _update(before: Array, w: Array, first: Array, row: Array) -> tuple[Array, ...]:
    """The window after one more sample, the gain in log evidence, and the smoothed window."""
    now = first
    for d in range(w.shape[1]):
        now = log_add(now, forwards(before[-1], d) + w[0, d])
    now = now + row
    gained = log_sum(now, 0)
    now = now - jnp.where(jnp.isfinite(gained), gained, 0.0)
    before = jnp.concatenate([before[1:], now[None]])
    return before, gained, *_smooth(before, w, jnp.zeros(len(row)))
