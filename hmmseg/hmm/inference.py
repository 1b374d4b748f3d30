"""Alignments and posteriors of recordings under a chain: the functions of hmmseg.hmm.

Log-likelihoods are (num_samples, num_states); a row of NaN is a missing sample, no evidence either way.
Sums are made in double precision, whatever the process's JAX is set to. Every function may be called in
two ways:

- on plain arrays: it compiles once for a short ladder of lengths, returns NumPy arrays, and raises
  InfeasibleAlignment where no path exists and ValueError for NaN beside numbers, for +inf and for wrong
  shapes;
- inside jit, vmap or grad, with `length` for what is no padding: nothing of the data can raise there, a
  log weight is -inf where no path exists and NaN where a row holds NaN beside numbers. vmap runs
  recordings one after the other on a CPU, together elsewhere.

`parallel`: solve the recursions in time by associative scans (see recursions.py); unless said, not on a
CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from hmmseg.hmm import recursions
from hmmseg.hmm.chain import Chain, not_numbers, why_infeasible
from hmmseg.hmm.results import Alignment, AlignmentPosterior, Posterior

SHORTEST = 128  # numerics: samples; the first step of the ladder of lengths
TOGETHER = 64  # numerics: recordings of one shape that make one call; what is over is done one by one


def ladder(num_samples: int) -> int:
    """The length to which a recording is padded: powers of two, from 4,096 on with quarters between them."""
    below = max(SHORTEST, 1 << (num_samples - 1).bit_length()) // 2
    step = below // 4 if below >= 4096 else 2 * below
    return -(-num_samples // step) * step


def viterbi(log_likelihoods: ArrayLike, chain: Chain, length: Any = None, *,
            parallel: bool | None = None) -> Alignment:  # fmt: skip
    """The most probable alignment; a tie goes to staying.

    Args:
        log_likelihoods: (num_samples, num_states).
        chain: of as many states.
        length: how many samples are no padding; all unless given.
        parallel: see the module.

    Raises:
        InfeasibleAlignment, ValueError: see the module.
    """
    return _run(_viterbi, log_likelihoods, chain, length, parallel)


def log_evidence(log_likelihoods: ArrayLike, chain: Chain, length: Any = None, *,
                 parallel: bool | None = None) -> Any:  # fmt: skip
    """Log of the summed weight of all paths.

    Differentiable once, in reverse: its gradient with respect to the log-likelihoods is the posterior
    probability of each state at each sample, with respect to the weights of a chain the expected number of
    moves. Arguments and exceptions as of `viterbi`.
    """
    return _run(_log_evidence, log_likelihoods, chain, length, parallel, _differentiable)


def smooth(log_likelihoods: ArrayLike, chain: Chain, length: Any = None, *,
           parallel: bool | None = None) -> Posterior:  # fmt: skip
    """Probabilities of states and boundaries given the whole recording; arguments as of `viterbi`."""
    return _run(_smooth, log_likelihoods, chain, length, parallel)


# What the functions compute: of rows x without NaN and a length n, padded or not, the log weight that must be
# finite for there to be an answer, and the answer.


def _tables(chain: Chain) -> tuple[jax.Array, jax.Array, jax.Array]:
    initial, final = (jnp.asarray(end).astype(jnp.float64) for end in (chain.log_initial, chain.log_final))
    return chain.by_target(jnp), initial, final


def _viterbi(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> tuple[Any, Alignment]:
    starts, log_prob = recursions.best_path(x, *_tables(chain), n, parallel=parallel)
    return log_prob, Alignment(starts, n, log_prob)


def _log_evidence(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> tuple[Any, Any]:
    total = recursions.evidence(x, *_tables(chain), n, parallel=parallel)
    return total, total


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _differentiable(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> jax.Array:
    """The log evidence in the precision of x. Its gradient is the posterior, in that of what it is of."""
    with jax.enable_x64(True):
        return _log_evidence(x, chain, n, parallel)[0].astype(x.dtype)


def _with_gradient(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> tuple[Any, Any]:
    with jax.enable_x64(True):
        total, states, moves = recursions.posterior(x, *_tables(chain), n, parallel=parallel)
        bands = [moves[:, d, d:] for d in range(len(chain.bands))]
        bands = [each if band.ndim == 2 else each.sum(0)
                 for each, band in zip(bands, chain.bands, strict=True)]  # fmt: skip
        ends = states[0], recursions.row(states, n - 1)
        by_chain = Chain.tree_unflatten(None, (tuple(bands), *ends))
        by_chain = jax.tree.map(lambda by, of: by.astype(of.dtype), by_chain, chain)
        gradient = jnp.where(jnp.isnan(x), 0.0, states).astype(x.dtype)
        return total.astype(x.dtype), (gradient, by_chain)


def _pull_back(parallel: bool | None, gradients: Any, cotangent: jax.Array) -> tuple[Any, Any, None]:
    del parallel
    return *jax.tree.map(lambda each: cotangent.astype(each.dtype) * each, gradients), None


_differentiable.defvjp(_with_gradient, _pull_back)


def _smooth(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> tuple[Any, Posterior]:
    total, states, moves = recursions.posterior(x, *_tables(chain), n, parallel=parallel)
    return total, Posterior(total, states, tuple(moves[:, d, d:] for d in range(1, moves.shape[1])))


def _align(x: jax.Array, chain: Chain, n: jax.Array, parallel: bool | None) -> tuple[Any, tuple]:
    total, posterior = _smooth(x, chain, n, parallel)
    return total, (_viterbi(x, chain, n, parallel)[1], posterior)


# How they are called.


def _run(core: Callable, log_likelihoods: Any, chain: Chain, length: Any, parallel: bool | None,
         inside: Callable | None = None) -> Any:  # fmt: skip
    """The core on one recording: traced where anything of it is, else compiled, as NumPy arrays."""
    leaves = jax.tree.leaves((log_likelihoods, chain, length))
    if not any(isinstance(leaf, Tracer) for leaf in leaves):
        table = checked(log_likelihoods, chain)
        if length is not None:
            if not 0 < int(length) <= len(table):
                raise ValueError(f"length: {length}, expected 1 to {len(table)}")
            table = table[: int(length)]
        return run_many(core, [table], [chain], parallel=parallel)[0]
    x = jnp.asarray(log_likelihoods)
    _check_shape(x, chain)
    with jax.enable_x64(True):
        # By way of uint32, as NumPy's 64 bits under vmap pass for 32 where JAX is set to these.
        n = jnp.asarray(len(x) if length is None else length).astype(jnp.uint32).astype(jnp.int32)
        kind = x.dtype if jnp.issubdtype(x.dtype, jnp.floating) else jnp.dtype(float)
        if inside is not None:
            return inside(
                x.astype(kind), jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), chain), n, parallel
            )
        found = core(x, chain, n, parallel)[1]
        return jax.tree.map(lambda a: a.astype(kind) if a.dtype == jnp.float64 else a, found)


def checked(log_likelihoods: ArrayLike, chain: Chain) -> np.ndarray:
    """Doubles (num_samples, num_states); ValueError for what is no such table."""
    ll = np.asarray(log_likelihoods, dtype=np.float64)
    _check_shape(ll, chain)
    missing = np.isnan(ll)
    if missing.any():
        partly = missing.any(1) & ~missing.all(1)
        if partly.any():
            raise not_numbers(ll, int(partly.argmax()))
    return ll


def _check_shape(ll: Any, chain: Chain) -> None:
    if ll.ndim != 2 or 0 in ll.shape:
        raise ValueError(f"log_likelihoods: shape {ll.shape}, expected (num_samples, num_states)")
    num_samples, num_states = ll.shape
    if num_states != chain.num_states:
        raise ValueError(f"log_likelihoods: {num_states} states, expected the chain's {chain.num_states}")
    if chain.num_samples is not None and chain.num_samples != num_samples:
        raise ValueError(
            f"log_likelihoods: {num_samples} samples, expected {chain.num_samples} as in the chain"
        )


def run_many(core: Callable, tables: Sequence[np.ndarray], chains: Sequence[Chain],
             parallel: bool | None = None) -> list:  # fmt: skip
    """The core on checked recordings, each padded to the ladder: one program for all of one shape.

    Raises InfeasibleAlignment, and ValueError for +inf.
    """
    if parallel is None:
        parallel = jax.default_backend() != "cpu"
    padded = [_padded(chain, len(ll)) for ll, chain in zip(tables, chains, strict=True)]
    groups: dict[Any, list[int]] = {}
    for i, (ll, chain) in enumerate(zip(tables, padded, strict=True)):
        leaves, kind = jax.tree.flatten(chain)
        groups.setdefault((ladder(len(ll)), kind, *(np.shape(leaf) for leaf in leaves)), []).append(i)
    found: list[Any] = [None] * len(tables)
    for (size, *_), members in groups.items():
        whole = len(members) // TOGETHER * TOGETHER
        parts = [members[i : i + TOGETHER] for i in range(0, whole, TOGETHER)] + [
            [i] for i in members[whole:]
        ]
        for part in parts:
            n = np.array([len(tables[i]) for i in part], np.int32)
            x = np.zeros((len(part), size, tables[part[0]].shape[1]))
            for row, i in zip(x, part, strict=True):
                row[: len(tables[i])] = tables[i]
            chain = jax.tree.map(lambda *leaves: np.stack(leaves), *(padded[i] for i in part))
            with jax.enable_x64(True):
                program = compiled(core, parallel)
                totals, results = jax.tree.map(np.asarray, program(x, chain, n))
            for j, i in enumerate(part):
                if not np.isfinite(totals[j]):
                    raise why_infeasible(tables[i], chains[i])
                found[i] = _trimmed(jax.tree.map(lambda leaf, j=j: leaf[j], results), len(tables[i]))
    return found


def align(log_likelihoods: Sequence[np.ndarray], chains: Sequence[Chain]) -> list[AlignmentPosterior]:
    """`viterbi` and `smooth` of several recordings, each with its chain, as EM takes them."""
    tables = [checked(ll, chain) for ll, chain in zip(log_likelihoods, chains, strict=True)]
    return [
        AlignmentPosterior(
            posterior.log_evidence, posterior.smoothed, posterior.moves, best.path, best.log_prob
        )
        for best, posterior in run_many(_align, tables, chains)
    ]


@cache
def compiled(core: Callable, parallel: bool) -> Callable:
    """The core for several recordings as one program."""

    def run(x: jax.Array, chain: Chain, n: jax.Array) -> Any:
        def one(args: tuple) -> Any:
            return core(*args, parallel)

        return jax.vmap(one)((x, chain, n)) if parallel else jax.lax.map(one, (x, chain, n))

    return jax.jit(run)


def _padded(chain: Chain, num_samples: int) -> Chain:
    """The chain for a recording that is padded to the ladder."""
    if chain.num_samples is None:
        return chain
    more = ladder(num_samples) - num_samples
    bands = tuple(
        np.pad(band, ((0, more), (0, 0)), constant_values=-np.inf) if band.ndim == 2 else band
        for band in map(np.asarray, chain.bands)
    )
    return Chain.tree_unflatten(None, (bands, chain.log_initial, chain.log_final))


def _trimmed(result: Any, n: int) -> Any:
    """The result without the rows of padding, numbers as Python has them."""
    if isinstance(result, tuple):
        return tuple(_trimmed(each, n) for each in result)
    if isinstance(result, Posterior):
        moves = tuple(move[: n - 1] for move in result.moves)
        return Posterior(float(result.log_evidence), result.smoothed[:n], moves)
    if isinstance(result, Alignment):
        return Alignment(result.starts.astype(np.int64), int(result.num_samples), float(result.log_prob))
    return float(result)
