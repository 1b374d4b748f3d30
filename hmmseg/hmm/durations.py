"""Chains whose states last by tables of durations (semi-Markov), of any shape and with no state split."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from hmmseg.hmm.chain import InfeasibleAlignment, jumps_between
from hmmseg.hmm.results import Alignments, Posterior

RARE = 1e-12  # numerics: durations that are longer than all but this share are left out


class DurationChain:
    """Left-to-right chain with a distribution of durations for each state.

    `log_durations`: one array a state, entry n - 1 the log probability (or weight) of lasting n samples; what
    is longer is impossible. `presence` (num_states,): probability that each state occurs at all; 1 unless
    given. `open_end`: the recording may cut the last state off, which then has lasted at least so long.
    `log_initial`, `log_final` (num_states,): weights of the first and of the last state; unless given,
    the first and last that occur. Raises ValueError on wrong shapes, NaN, +inf and a state without a
    possible duration.
    """

    varying, num_samples = False, None  # as of a Chain whose weights do not change in time

    def __init__(self, log_durations: Sequence[ArrayLike], presence: ArrayLike | None = None, *,
                 open_end: bool = False, log_initial: ArrayLike | None = None,
                 log_final: ArrayLike | None = None) -> None:  # fmt: skip
        tables = [np.asarray(table, dtype=np.float64) for table in log_durations]
        if not tables:
            raise ValueError("log_durations: none, expected one array a state")
        for k, table in enumerate(tables):
            if table.ndim != 1 or not table.size:
                raise ValueError(f"log_durations: shape {table.shape} of state {k}, expected (longest,)")
            if not table.max() < np.inf or not np.isfinite(table.max()):
                raise ValueError(f"log_durations: state {k}, expected numbers or -inf, at least one number")
        self.num_states = len(tables)
        self.longest = np.array([np.flatnonzero(np.isfinite(table)).max() + 1 for table in tables])
        self.pmf = np.full((self.num_states, int(self.longest.max())), -np.inf)
        for row, table, n in zip(self.pmf, tables, self.longest, strict=True):
            row[:n] = table[:n]
        self.survival = self.pmf
        if open_end:
            self.survival = np.logaddexp.accumulate(self.pmf[:, ::-1], axis=1)[:, ::-1].copy()
        jumps, initial, final = jumps_between(np.ones(self.num_states) if presence is None else presence)
        if len(initial) != self.num_states:
            raise ValueError(f"presence: shape {initial.shape}, expected {(self.num_states,)}")
        self.jumps = np.full((len(jumps), self.num_states), -np.inf)
        for row, jump in zip(self.jumps, jumps, strict=True):
            row[: jump.size] = jump
        self.log_initial = self._end("log_initial", log_initial, initial)
        self.log_final = self._end("log_final", log_final, final)

    def _end(self, name: str, given: ArrayLike | None, otherwise: np.ndarray) -> np.ndarray:
        end = np.ascontiguousarray(otherwise if given is None else given, dtype=np.float64)
        if end.shape != (self.num_states,):
            raise ValueError(f"{name}: shape {end.shape}, expected {(self.num_states,)}")
        if not end.max() < np.inf:
            raise ValueError(f"{name}: {end.tolist()}, expected numbers or -inf")
        return end

    @property
    def tables(self) -> tuple:
        """What every kernel takes of it first."""
        return self.pmf, self.survival, self.longest, self.jumps


def lasting(mean_samples: ArrayLike, sd_samples: ArrayLike, presence: ArrayLike | None = None, *,
            open_end: bool = False) -> DurationChain:  # fmt: skip
    """Chain of durations with these means and standard deviations [samples]: gamma, read in whole samples.

    Raises ValueError where one is not above 0 or the shapes differ.
    """
    from scipy.stats import gamma

    means, sds = np.asarray(mean_samples, dtype=float), np.asarray(sd_samples, dtype=float)
    means, sds = np.broadcast_arrays(means, sds)
    if means.ndim != 1 or not ((means > 0) & (sds > 0)).all():
        raise ValueError("lasting: expected one mean and one standard deviation above 0 for each state")
    tables = []
    for mean, sd in zip(means, sds, strict=True):
        lasting_for = gamma((mean / sd) ** 2, scale=sd**2 / mean)
        edges = np.arange(1, max(int(np.ceil(lasting_for.isf(RARE))), 1) + 1) + 0.5
        below = np.append(0.0, lasting_for.cdf(edges))
        with np.errstate(divide="ignore"):
            tables.append(np.log(np.diff(below) / below[-1]))
    return DurationChain(tables, presence, open_end=open_end)


def smooth(x: np.ndarray, chain: DurationChain) -> Posterior:
    """Probabilities of states and boundaries; x (num_samples, num_states) without NaN."""
    from hmmseg.hmm.kernels.durations import smooth_durations

    state = np.empty(x.shape)
    moved = np.zeros((len(x) - 1, len(chain.jumps), chain.num_states))
    total = smooth_durations(x, *chain.tables, chain.log_initial, chain.log_final, state, moved)
    if not np.isfinite(total):
        raise why_infeasible(x, chain)
    moves = tuple(moved[:, d, : max(chain.num_states - d - 1, 0)] for d in range(len(chain.jumps)))
    return Posterior(total, state, moves)


def forward(x: np.ndarray, chain: DurationChain) -> tuple[float, np.ndarray, np.ndarray]:
    """Log evidence, and the weights before each state begins and after each ends (see the kernels)."""
    from hmmseg.hmm.kernels.durations import forward_durations

    enter, leave = np.empty(x.shape), np.empty((len(x) + 1, chain.num_states))
    total = forward_durations(x, *chain.tables, chain.log_initial, chain.log_final, enter, leave)
    if not np.isfinite(total):
        raise why_infeasible(x, chain, enter)
    return total, enter, leave


def sample(x: np.ndarray, chain: DurationChain, num_draws: int, seed: int) -> Alignments:
    """Independent exact draws; `log_prob` is NaN."""
    from hmmseg.hmm.kernels.durations import draw_durations

    _, enter, leave = forward(x, chain)
    starts, rng = np.empty((num_draws, chain.num_states), np.int64), np.random.default_rng(seed)
    draw_durations(x, *chain.tables, chain.log_final, enter, leave, rng, starts)
    return Alignments(starts, np.full(num_draws, len(x)), np.full(num_draws, np.nan))


def k_best(x: np.ndarray, chain: DurationChain, k: int) -> Alignments:
    """The k most probable alignments, best first; fewer where fewer are possible."""
    from hmmseg.hmm.kernels.durations import best_durations

    starts, log_prob = np.empty((k, chain.num_states), np.int64), np.empty(k)
    best_durations(x, *chain.tables, chain.log_initial, chain.log_final, starts, log_prob)
    if not np.isfinite(log_prob[0]):
        raise why_infeasible(x, chain)
    keep = int(np.isfinite(log_prob).sum())
    return Alignments(starts[:keep], np.full(keep, len(x)), log_prob[:keep])


def why_infeasible(x: np.ndarray, chain: DurationChain, enter: np.ndarray | None = None) -> ValueError:
    """What to raise where no path has any weight: ValueError for +inf, else InfeasibleAlignment."""
    from hmmseg.hmm.kernels.durations import forward_durations

    if np.isposinf(x).any():
        return ValueError(f"log_likelihoods: +inf at {np.argwhere(np.isposinf(x))[0].tolist()}, "
                          "expected numbers or -inf")  # fmt: skip
    if enter is None:
        enter = np.empty(x.shape)
        leave = np.empty((len(x) + 1, chain.num_states))
        forward_durations(x, *chain.tables, chain.log_initial, chain.log_final, enter, leave)
    deepest = int(np.flatnonzero(np.isfinite(enter).any(axis=0)).max(initial=0))
    return InfeasibleAlignment(deepest, "none of its durations leads to what has to follow")
