"""The same posterior while samples arrive: filtered at once, smoothed after a fixed lag.

Memory and time a sample are O(num_states lag), however long the stream is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hmmseg.hmm.chain import Chain, InfeasibleAlignment
from hmmseg.hmm.durations import DurationChain

_SPARE = 64  # numerics: rows; the window moves to the front of its table only once in so many samples or more
_LN2 = math.log(2)  # physics: a logarithm


@dataclass(frozen=True)
class Step:
    """What one more sample tells.

    `sample`: its number. `filtered` (num_states,): probability of each state at it. `log_evidence`: log
    weight of all paths so far, wherever they are. Of the sample `lag` earlier, given all so far:
    `smoothed` (num_states,), and `boundary` (num_states - 1,), the probability that states up to k ended
    right before it; both None while the stream is shorter than that.
    """

    sample: int
    filtered: np.ndarray
    log_evidence: float
    smoothed: np.ndarray | None
    boundary: np.ndarray | None


@dataclass(frozen=True)
class Window:
    """Samples `first`, first + 1, ... given all that has come.

    `smoothed` (n, num_states); `boundary` (n, num_states - 1): the probability that states up to k ended
    right before each sample (zeros for sample 0).
    """

    first: int
    smoothed: np.ndarray
    boundary: np.ndarray


class StreamingFilter:
    """Follows a stream through a chain whose weights do not vary in time.

    `lag` [samples]: how long a sample is waited for before it is smoothed (0: not at all); boundary
    posteriors summed over time are those of fixed-lag smoothing. Raises ValueError for a chain that varies
    or a negative lag.
    """

    def __init__(self, chain: Chain | DurationChain, lag: int) -> None:
        if not isinstance(chain, Chain):
            raise ValueError("chain: tables of durations, expected a Chain: they would need the whole stream")
        if chain.varying:
            raise ValueError(
                "chain: varies in time, expected one that does not, as a stream has no known end"
            )
        if lag < 0:
            raise ValueError(f"lag: {lag}, expected 0 or more samples")
        self.chain, self.lag = chain, lag
        self.num_samples = 0
        self._general = len(chain.bands) > 2
        rows, k = 2 * (lag + 2) + _SPARE, chain.num_states
        if self._general:
            self._bands = chain.stacked()
            self._am, self._pm = np.empty((rows, k)), np.empty((rows, k))
        else:
            from hmmseg.hmm.kernels.blocks import PAD, row_width

            width = row_width(k)
            self._am, self._ae = np.ones((rows, width)), np.zeros((rows, width), np.int64)
            self._pm, self._pe = np.ones(rows * k + 2 * PAD), np.zeros(rows * k + 2 * PAD, np.int64)
            self._x = np.zeros(k + 2 * PAD)
        self._head = -1  # the row of the last sample
        self._base = 0.0  # log weight taken out of all rows

    def update(self, log_likelihood: ArrayLike) -> Step:
        """One sample's log-likelihoods (num_states,); NaN throughout: a missing sample.

        Raises InfeasibleAlignment where no state is possible any more, ValueError for NaN beside numbers
        and for +inf; the stream then is as if the sample had not come.
        """
        row = np.ascontiguousarray(log_likelihood, dtype=np.float64)
        k = self.chain.num_states
        if row.shape != (k,):
            raise ValueError(f"log_likelihood: shape {row.shape}, expected {(k,)}")
        if self._head + 1 == len(self._am):
            self._to_front()
        head = self._head + 1
        filtered = np.empty((1, k))
        weight = self._push(row, head, filtered)
        if not -math.inf < weight < math.inf:
            raise self._refusal(row, weight)
        self._head = head
        sample, self.num_samples = self.num_samples, self.num_samples + 1
        lagged = sample - self.lag
        if lagged < 0:
            smoothed = boundary = None
        else:
            found = self._window(min(self.lag, sample), False)
            smoothed, boundary = found.smoothed[0], found.boundary[0]
        return Step(sample, filtered[0], self._base + weight, smoothed, boundary)

    def window(self) -> Window:
        """The last lag + 1 samples, given all that has come and without knowing whether more will."""
        return self._window(min(self.lag, self.num_samples - 1), False)

    def finish(self) -> Window:
        """The samples that no step has smoothed, given the whole stream and where the chain has to end.

        Raises InfeasibleAlignment where it cannot have ended there.
        """
        return self._window(min(self.lag - 1, self.num_samples - 1), True)

    def _window(self, back: int, ended: bool) -> Window:
        if self.num_samples == 0:
            raise ValueError("stream: no sample has come, expected at least one")
        k, num = self.chain.num_states, back + 1
        sample = self.num_samples - num
        before = 1 if sample else 0  # one sample more, for the boundary before the first
        smoothed, boundary = np.empty((num + before, k)), np.zeros((num + before - 1, k - 1))
        first = self._head - back - before
        if num and not self._fill(first, ended, smoothed, boundary):
            raise InfeasibleAlignment(k - 1, "reached, but cannot be held to the end")
        if not before:
            boundary = np.vstack([np.zeros((min(num, 1), k - 1)), boundary])
        return Window(sample, smoothed[before:], boundary)

    def _push(self, row: np.ndarray, head: int, filtered: np.ndarray) -> float:
        if self._general:
            from hmmseg.hmm.kernels.stream import push_general

            missing = np.isnan(row)
            if missing.any() and not missing.all():
                return math.nan
            return push_general(np.where(missing, 0.0, row), self._bands, self.chain.log_initial,
                                self.num_samples, head, self._am, self._pm, filtered)  # fmt: skip
        from hmmseg.hmm.kernels.stream import push

        return push(row.ctypes.data, row.size, self.chain.addresses, self.num_samples, head, self._am,
                    self._ae, self._pm, self._pe, self._x, filtered)  # fmt: skip

    def _fill(self, first: int, ended: bool, smoothed: np.ndarray, boundary: np.ndarray) -> bool:
        if self._general:
            from hmmseg.hmm.kernels.stream import window_general

            return window_general(self._bands, self.chain.log_final, first, self._head, self._am, self._pm,
                                  ended, smoothed, boundary)  # fmt: skip
        from hmmseg.hmm.kernels.stream import window

        return window(self.chain.num_states, self.chain.addresses, first, self._head, self._am, self._ae,
                      self._pm, self._pe, ended, smoothed, boundary)  # fmt: skip

    def _to_front(self) -> None:
        """Move the last rows to the front, and take their common weight out of them."""
        k, first = self.chain.num_states, self._head - self.lag - 1
        kept = self.lag + 2
        if self._general:
            top = float(self._am[self._head].max())
            self._am[:kept] = self._am[first : self._head + 1] - top
            self._pm[:kept] = self._pm[first : self._head + 1]
            self._base += top
        else:
            from hmmseg.hmm.kernels.blocks import PAD
            from hmmseg.hmm.kernels.stream import rebase

            self._base += rebase(self._am, self._ae, first, self._head, k) * _LN2
            for table in (self._pm, self._pe):
                table[PAD : PAD + kept * k] = table[PAD + first * k : PAD + (self._head + 1) * k]
        self._head = kept - 1

    def _refusal(self, row: np.ndarray, weight: float) -> ValueError:
        if math.isnan(weight) or np.isposinf(row).any():
            return ValueError(
                f"log_likelihood: {row.tolist()}, expected numbers or -inf (missing: NaN throughout)"
            )
        k = self.chain.num_states
        reached = -1
        if self.num_samples:
            reached = int(np.flatnonzero(self._window(0, False).smoothed[0]).max(initial=-1))
        return InfeasibleAlignment(
            min(reached + 1, k - 1), f"no state is possible at sample {self.num_samples}"
        )
