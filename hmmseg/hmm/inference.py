"""Alignments and posteriors of recordings under a chain: the functions of hmmseg.hmm.

Log-likelihoods are (num_samples, num_states), in single or double precision; sums are always made
in double precision. A row of NaN is a missing sample, no evidence either way. InfeasibleAlignment is
raised where no path exists, ValueError for NaN beside numbers, for +inf and for wrong shapes.

Recursions: Rabiner, Proc. IEEE 77(2), 1989; forward filtering, backward sampling: Scott, J. Am. Stat.
Assoc. 97, 2002.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmmseg.hmm import durations
from hmmseg.hmm.chain import Chain, not_numbers, why_infeasible
from hmmseg.hmm.durations import DurationChain
from hmmseg.hmm.results import Alignment, Alignments, Filtered, Posterior

Tables = Any  # one array, or a sequence of arrays
AnyChain = Chain | DurationChain
_NONE = np.empty((0, 0))  # numerics: stands for bands that a chain does not have
_SINGLE, _DOUBLE = np.dtype(np.float32), np.dtype(np.float64)
_CELLS_A_THREAD = 1 << 17  # numerics: below, another thread costs more than it saves


def table(log_likelihoods: ArrayLike, chain: AnyChain) -> np.ndarray:
    """The log-likelihoods as the kernels take them; ValueError where their shape is not the chain's."""
    ll = np.asarray(log_likelihoods)
    if ll.dtype != _DOUBLE and ll.dtype != _SINGLE:
        ll = ll.astype(np.float64)
    if ll.ndim != 2 or 0 in ll.shape:
        raise ValueError(f"log_likelihoods: shape {ll.shape}, expected (num_samples, num_states)")
    num_samples, num_states = ll.shape
    if num_states != chain.num_states:
        raise ValueError(f"log_likelihoods: {num_states} states, expected the chain's {chain.num_states}")
    if chain.num_samples is not None and chain.num_samples != num_samples:
        raise ValueError(
            f"log_likelihoods: {num_samples} samples, expected {chain.num_samples} as in the chain"
        )
    return ll if ll.flags.c_contiguous else np.ascontiguousarray(ll)


def filled(ll: np.ndarray) -> np.ndarray:
    """Doubles with zeros, no evidence, in rows of NaN; ValueError for NaN beside numbers."""
    x = np.array(ll, dtype=np.float64)
    missing = np.isnan(x)
    if missing.any():
        partly = missing.any(1) & ~missing.all(1)
        if partly.any():
            raise not_numbers(x, int(partly.argmax()))
        x[missing] = 0.0
    return x


def viterbi(log_likelihoods: Tables, chain: AnyChain | Sequence[AnyChain],
            lengths: Sequence[int] | np.ndarray | None = None) -> Alignment | Alignments:  # fmt: skip
    """Most probable alignment; of each recording where there are several. A tie goes to staying.

    Several recordings: a sequence of tables, or one array (num_recordings, num_samples, num_states)
    with the `lengths` (num_recordings,) of what is no padding; with one chain or one for each.
    """
    if getattr(log_likelihoods, "ndim", 0) == 2 and isinstance(chain, AnyChain):
        return _viterbi_one(table(log_likelihoods, chain), chain)
    return _viterbi_many(*recordings(log_likelihoods, chain, lengths))


def recordings(
    log_likelihoods: Tables, chain: AnyChain | Sequence[AnyChain], lengths: Sequence[int] | np.ndarray | None
) -> tuple[list[np.ndarray], list[AnyChain]]:
    """Tables and chains of several recordings."""
    tables = list(log_likelihoods)
    if lengths is not None:
        if len(lengths) != len(tables):
            raise ValueError(f"lengths: {len(lengths)} given, expected {len(tables)}, one a recording")
        for i, n in enumerate(lengths):
            if not 0 < n <= len(tables[i]):
                raise ValueError(f"lengths: {n} for recording {i}, expected 1 to {len(tables[i])}")
        tables = [each[:n] for each, n in zip(tables, lengths, strict=True)]
    chains = [chain] * len(tables) if isinstance(chain, AnyChain) else list(chain)
    if len(chains) != len(tables):
        raise ValueError(f"chain: {len(chains)} given, expected {len(tables)}, one a recording")
    return [table(ll, c) for ll, c in zip(tables, chains, strict=True)], chains


def _viterbi_one(ll: np.ndarray, chain: AnyChain) -> Alignment:
    if isinstance(chain, DurationChain):
        return durations.k_best(filled(ll), chain, 1)[0]
    if len(chain.bands) > 2:
        from hmmseg.hmm.kernels.general import best_general

        starts = np.empty(chain.num_states, np.int64)
        log_prob = best_general(
            filled(ll), chain.stacked(), chain.varying, chain.log_initial, chain.log_final, starts
        )
    else:
        from hmmseg.hmm.kernels.best_path import best_path

        found = np.empty((1, chain.num_states), np.int64)
        log_prob, bad = best_path(ll.ctypes.data, ll.dtype == _SINGLE, len(ll), chain.num_states,
                                  *chain.addresses, found, 0)  # fmt: skip
        if bad >= 0:
            raise not_numbers(ll, bad)
        starts = found[0]
    if not -np.inf < log_prob < np.inf:
        raise why_infeasible(ll, chain)
    return Alignment(starts, len(ll), log_prob)


def _viterbi_many(tables: list[np.ndarray], mixed: list[AnyChain]) -> Alignments:
    lengths = np.array([len(ll) for ll in tables], dtype=np.int64)
    chains = [c for c in mixed if isinstance(c, Chain)]
    kinds = {(c.num_states, c.varying, len(c.bands), ll.dtype) for c, ll in zip(chains, tables, strict=False)}
    if len(chains) < len(mixed) or len(kinds) > 1 or (chains and len(chains[0].bands) > 2):
        each = [_viterbi_one(ll, c) for ll, c in zip(tables, mixed, strict=True)]
        return Alignments(np.array([a.starts for a in each]), lengths, np.array([a.log_prob for a in each]))
    if not tables:
        return Alignments(np.empty((0, 0), np.int64), lengths, np.empty(0))
    from hmmseg.hmm.kernels.best_path import best_paths

    num_states = chains[0].num_states
    starts, log_prob = np.empty((len(tables), num_states), np.int64), np.empty(len(tables))
    ll = np.array([each.ctypes.data for each in tables], dtype=np.int64)
    if len(set(map(id, chains))) == 1:
        ends = chains[0].addresses
        stay, advance, initial, final = (np.full(len(tables), ends[i]) for i in (0, 1, 3, 4))
    else:
        columns = np.array([c.addresses for c in chains], dtype=np.int64).T
        stay, advance, initial, final = (np.ascontiguousarray(columns[i]) for i in (0, 1, 3, 4))
    fixed = (
        lengths,
        tables[0].dtype == _SINGLE,
        num_states,
        stay,
        advance,
        chains[0].varying,
        initial,
        final,
    )

    def run(part: tuple[int, int]) -> tuple[int, int]:
        return best_paths(ll, *fixed, starts, log_prob, *part)

    for i, row in in_threads(run, lengths, num_states):
        if i >= 0:
            raise not_numbers(tables[i], row)
    for i in np.flatnonzero(~np.isfinite(log_prob)):
        raise why_infeasible(tables[i], chains[i])
    return Alignments(starts, lengths, log_prob)


def in_threads(run, lengths: np.ndarray, num_states: int) -> list:
    """`run` for parts (first, last) of the recordings, alike in samples, one a processor."""
    cells = int(lengths.sum()) * num_states
    num = max(min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
                  cells // _CELLS_A_THREAD, len(lengths)), 1)  # fmt: skip
    if num == 1:
        return [run((0, len(lengths)))]
    cumulative = np.cumsum(lengths)
    cuts = [0, *np.searchsorted(cumulative, cumulative[-1] * np.arange(1, num) / num), len(lengths)]
    with ThreadPoolExecutor(num) as pool:
        return list(pool.map(run, [(int(a), int(b)) for a, b in pairwise(cuts)]))


def filtered_table(ll: np.ndarray, chain: Chain, table: np.ndarray, logs: bool = False) -> float:
    """Log evidence; filtered probabilities, or their logs, into `table`, empty where not asked for."""
    if len(chain.bands) > 2:
        from hmmseg.hmm.kernels.general import smooth_general

        none = np.empty((0, len(chain.bands) - 1, chain.num_states))
        found = smooth_general(filled(ll), chain.stacked(), chain.varying, chain.log_initial,
                               chain.log_final, table, _NONE, none)  # fmt: skip
        if not logs:
            np.exp(table, out=table)
        return _possible(found, -1, ll, chain)
    from hmmseg.hmm.kernels.forward import evidence

    found, bad = evidence(ll.ctypes.data, ll.dtype == _SINGLE, *ll.shape, *chain.addresses, table, logs)
    return _possible(found, bad, ll, chain)


def smoothed_tables(ll: np.ndarray, chain: Chain) -> tuple[float, np.ndarray, tuple[np.ndarray, ...]]:
    """Log evidence, and probabilities of states and moves as in Posterior."""
    num_samples, num_states = ll.shape
    if len(chain.bands) > 2:
        from hmmseg.hmm.kernels.general import smooth_general

        state = np.empty((num_samples, num_states))
        moved = np.empty((num_samples - 1, len(chain.bands) - 1, num_states))
        found = smooth_general(filled(ll), chain.stacked(), chain.varying, chain.log_initial,
                               chain.log_final, _NONE, state, moved)  # fmt: skip
        log_evidence = _possible(found, -1, ll, chain)
        moves = (moved[:, d - 1, : max(num_states - d, 0)] for d in range(1, len(chain.bands)))
        return log_evidence, np.exp(state), tuple(np.exp(each) for each in moves)
    from hmmseg.hmm.kernels.smoothing import probabilities

    # One row a state: the system hands out memory only where something is written.
    state, boundary = np.zeros((num_states, num_samples)), np.zeros((num_states - 1, num_samples - 1))
    found, bad = probabilities(ll.ctypes.data, ll.dtype == _SINGLE, num_samples, num_states, *chain.addresses,
                               state, boundary)  # fmt: skip
    return _possible(found, bad, ll, chain), state.T, (boundary.T,)


def _possible(log_evidence: float, bad: int, ll: np.ndarray, chain: Chain) -> float:
    """The log evidence; raises where there is none."""
    if bad >= 0:
        raise not_numbers(ll, bad)
    if not -np.inf < log_evidence < np.inf:
        raise why_infeasible(ll, chain)
    return log_evidence


def log_evidence(log_likelihoods: ArrayLike, chain: AnyChain) -> float:
    """Log of the summed weight of all paths."""
    if isinstance(chain, DurationChain):
        return durations.forward(filled(table(log_likelihoods, chain)), chain)[0]
    return filtered_table(table(log_likelihoods, chain), chain, _NONE)


def forward(log_likelihoods: ArrayLike, chain: AnyChain) -> Filtered:
    """Filtered probabilities: what each sample says together with those before it."""
    if not isinstance(chain, Chain):
        raise ValueError("chain: tables of durations, expected a Chain")
    ll = table(log_likelihoods, chain)
    filtered = np.empty(ll.shape)
    return Filtered(filtered_table(ll, chain, filtered), filtered)


def smooth(log_likelihoods: ArrayLike, chain: AnyChain) -> Posterior:
    """Probabilities of states and boundaries given the whole recording."""
    if isinstance(chain, DurationChain):
        return durations.smooth(filled(table(log_likelihoods, chain)), chain)
    return Posterior(*smoothed_tables(table(log_likelihoods, chain), chain))


def sample(log_likelihoods: ArrayLike, chain: AnyChain, num_draws: int, seed: int = 0) -> Alignments:
    """Independent exact draws from the posterior over alignments; `log_prob` is NaN."""
    if isinstance(chain, DurationChain):
        return durations.sample(filled(table(log_likelihoods, chain)), chain, num_draws, seed)
    from hmmseg.hmm.kernels.general import draw_starts

    ll = table(log_likelihoods, chain)
    online = np.empty(ll.shape)
    filtered_table(ll, chain, online, logs=True)
    rng = np.random.default_rng(seed)
    starts = np.empty((num_draws, chain.num_states), np.int64)
    draw_starts(online, chain.stacked(), chain.varying, chain.log_final, rng.random(num_draws), rng, starts)
    return Alignments(starts, np.full(num_draws, len(ll)), np.full(num_draws, np.nan))


def k_best(log_likelihoods: ArrayLike, chain: AnyChain, k: int) -> Alignments:
    """The k most probable alignments, best first; fewer where fewer are possible."""
    from hmmseg.hmm.kernels.general import best_k

    if not 0 < k < 1 << 16:
        raise ValueError(f"k: {k}, expected 1 to 65535")
    ll = table(log_likelihoods, chain)
    if isinstance(chain, DurationChain):
        return durations.k_best(filled(ll), chain, k)
    starts, log_prob = np.empty((k, chain.num_states), np.int64), np.empty(k)
    best_k(filled(ll), chain.stacked(), chain.varying, chain.log_initial, chain.log_final, starts, log_prob)
    if not np.isfinite(log_prob[0]):
        raise why_infeasible(ll, chain)
    keep = int(np.isfinite(log_prob).sum())
    return Alignments(starts[:keep], np.full(keep, len(ll)), log_prob[:keep])
