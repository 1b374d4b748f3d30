"""Alignments and posteriors of recordings under a chain: the functions of hmmseg.hmm.

Log-likelihoods are (num_samples, num_states); a row of NaN is a missing sample, no evidence either way. Sums
are in double precision, whatever the process's JAX setting. Every function can be called in two ways:

- on plain arrays: it is compiled once for each of a short ladder of lengths, returns NumPy arrays, and raises
  InfeasibleAlignment if no path exists and ValueError for NaN beside numbers, for +inf and for wrong shapes;
- inside jit, vmap or grad, with `length` to exclude padding: the data cannot raise there; a log weight is
  -inf if no path exists and NaN if a row holds NaN beside numbers. vmap runs recordings in turn on a CPU,
  together elsewhere.

`parallel`: solve the recursions in time by associative scans (see recursions.py); by default not on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from hmmseg.hmm import durations, recursions
from hmmseg.hmm.chain import Chain, not_a_number, why_infeasible
from hmmseg.hmm.durations import DurationChain
from hmmseg.hmm.results import Alignment, AlignmentPosterior, Alignments, Filtered, Posterior

AnyChain = Chain | DurationChain
Core = Callable[..., Any]
SHORTEST = 128  # numerics: samples; the first step of the ladder of lengths
TOGETHER = 64  # numerics: recordings of one shape per call; the remainder is processed one by one
MAX_RANKS = 65_535  # limit: of k_best


def ladder(num_samples: int) -> int:
    """Padded length of a recording: powers of two, from 4,096 on with quarter steps between them."""
    below = max(SHORTEST, 1 << (num_samples - 1).bit_length()) // 2
    step = below // 4 if below >= 4096 else 2 * below
    return -(-num_samples // step) * step


def viterbi(log_likelihoods: Any, chain: Any, lengths: Any = None, *,
            parallel: bool | None = None) -> Any:  # fmt: skip
    """The most probable alignment; a tie goes to staying.

    Args:
        log_likelihoods: (num_samples, num_states). Several recordings, not under jit: a sequence of such
            arrays, or (num_recordings, num_samples, num_states) with `lengths` (num_recordings,).
        chain: one, or one per recording.
        lengths: number of samples that are no padding; all by default.
        parallel: see the module.

    Returns:
        Alignment, for several recordings Alignments.

    Raises:
        InfeasibleAlignment, ValueError: see the module.
    """
    if getattr(log_likelihoods, "ndim", 0) == 2 and isinstance(chain, AnyChain):
        return _run(_viterbi, log_likelihoods, chain, lengths, parallel=parallel)
    tables, chains = recordings(log_likelihoods, chain, lengths)
    best = run_many(_viterbi, tables, chains, parallel=parallel)
    num_states = chains[0].num_states if chains else 0
    return Alignments(
        np.array([a.starts for a in best], np.int64).reshape(len(best), num_states),
        np.array([a.num_samples for a in best], np.int64),
        np.array([a.log_prob for a in best], float),
    )


def log_evidence(log_likelihoods: ArrayLike, chain: AnyChain, length: Any = None, *,
                 parallel: bool | None = None) -> Any:  # fmt: skip
    """Log of the summed weight of all paths.

    Differentiable once, in reverse mode: the gradient with respect to the log-likelihoods is the posterior
    probability of each state at each sample, with respect to the weights of a chain the expected number of
    moves. Arguments and exceptions as of `viterbi`.
    """
    return _run(_log_evidence, log_likelihoods, chain, length, parallel=parallel, inside=_differentiable)


def filter(log_likelihoods: ArrayLike, chain: AnyChain, length: Any = None, *,
           parallel: bool | None = None) -> Filtered:  # fmt: skip
    """Probabilities of states given the samples so far. Arguments and exceptions as of `viterbi`."""
    return _run(_filter, log_likelihoods, chain, length, parallel=parallel)


def smooth(log_likelihoods: ArrayLike, chain: AnyChain, length: Any = None, *,
           parallel: bool | None = None) -> Posterior:  # fmt: skip
    """Probabilities of states and boundaries given the whole recording; arguments as of `viterbi`."""
    return _run(_smooth, log_likelihoods, chain, length, parallel=parallel)


def sample(log_likelihoods: ArrayLike, chain: AnyChain, num_draws: int, seed: Any = 0,
           length: Any = None) -> Alignments:  # fmt: skip
    """Independent exact draws from the posterior over alignments.

    `seed`: an integer, or a key of jax.random. `log_prob` is NaN. Further arguments as of `viterbi`.
    """
    key = jax.random.key(seed) if isinstance(seed, (int, np.integer)) else seed
    return _run(_sample, log_likelihoods, chain, length, key, num_draws=num_draws, parallel=None)


def k_best(log_likelihoods: ArrayLike, chain: AnyChain, k: int, length: Any = None) -> Alignments:
    """The k most probable alignments, best first; fewer if fewer are possible (under jit: -inf).

    Arguments and exceptions as of `viterbi`.
    """
    if not 0 < k <= MAX_RANKS:
        raise ValueError(f"k: {k}, expected 1 to {MAX_RANKS}")
    best = _run(_k_best, log_likelihoods, chain, length, k=k, parallel=None)
    if not isinstance(best.log_prob, np.ndarray):
        return best
    keep = int(np.isfinite(best.log_prob).sum())
    return Alignments(best.starts[:keep], best.num_samples[:keep], best.log_prob[:keep])


# The cores: of log-likelihoods x, padded or not, with n valid rows, each returns the log weight that must be
# finite for an answer to exist, and the answer.


def _solver(chain: Any, parallel: bool | None = None) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """The module of a chain's recursions, its weights as their arguments, and how to go through time."""
    if isinstance(chain, DurationChain):
        return durations, (chain,), {}
    initial, final = (jnp.asarray(end).astype(jnp.float64) for end in (chain.log_initial, chain.log_final))
    return recursions, (chain.by_target(jnp), initial, final), {"parallel": parallel}


def _viterbi(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, Alignment]:
    solver, weights, how = _solver(chain, parallel)
    starts, log_prob = solver.best_path(x, *weights, n, **how)
    return log_prob, Alignment(starts, n, log_prob)


def _log_evidence(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, Any]:
    solver, weights, how = _solver(chain, parallel)
    total = solver.evidence(x, *weights, n, **how)
    return total, total


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _differentiable(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> jax.Array:
    """The log evidence in the precision of x; gradients are posteriors in that of their argument."""
    with jax.enable_x64(True):
        return _log_evidence(x, chain, n, parallel)[0].astype(x.dtype)


def _with_gradient(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, Any]:
    with jax.enable_x64(True):
        solver, weights, how = _solver(chain, parallel)
        total, states, moves = solver.posterior(x, *weights, n, **how)
        by_chain = None
        if isinstance(chain, Chain):
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


def _filter(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, Filtered]:
    if isinstance(chain, DurationChain):
        raise ValueError("chain: tables of durations, expected a Chain")
    w, initial, final = _solver(chain)[1]
    table, taken = recursions.forward(x, w, initial, n, recursions.log_add, parallel)
    table = jnp.where((recursions.numbers(len(x)) < n)[:, None], table, recursions.NEVER)
    total = recursions.log_sum(recursions.row(table, n - 1) + final, 0) + taken
    return total, Filtered(total, recursions.probabilities(table, 1))


def _smooth(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, Posterior]:
    solver, weights, how = _solver(chain, parallel)
    total, states, moves = solver.posterior(x, *weights, n, **how)
    return total, Posterior(total, states, tuple(moves[:, d, d:] for d in range(1, moves.shape[1])))


def _sample(x: jax.Array, chain: Any, n: jax.Array, key: jax.Array, num_draws: int,
            parallel: bool | None) -> tuple[Any, Alignments]:  # fmt: skip
    solver, weights, how = _solver(chain, parallel)
    total, starts = solver.draw(x, *weights, n, key, num_draws, **how)
    unknown = jnp.where(jnp.isfinite(total), jnp.nan, total)  # -inf if there is no path to draw
    return total, Alignments(starts, jnp.full(num_draws, n), jnp.full(num_draws, unknown))


def _k_best(x: jax.Array, chain: Any, n: jax.Array, k: int,
            parallel: bool | None) -> tuple[Any, Alignments]:  # fmt: skip
    del parallel  # ranks are computed row by row on every device
    solver, weights, _ = _solver(chain)
    starts, log_prob = solver.rank(x, *weights, n, k)
    return log_prob[0], Alignments(starts, jnp.full(k, n), log_prob)


def _align(x: jax.Array, chain: Any, n: jax.Array, parallel: bool | None) -> tuple[Any, tuple[Any, ...]]:
    total, posterior = _smooth(x, chain, n, parallel)
    return total, (_viterbi(x, chain, n, parallel)[1], posterior)


# How the cores are called.


def _run(core: Core, log_likelihoods: Any, chain: Any, length: Any, *keys: Any,
         inside: Core | None = None, parallel: bool | None, **static: Any) -> Any:  # fmt: skip
    """Run a core on one recording: inline if anything is traced, else compiled, returning NumPy arrays."""
    leaves = jax.tree.leaves((log_likelihoods, chain, length, keys))
    if not any(isinstance(leaf, Tracer) for leaf in leaves):
        table = checked(log_likelihoods, chain)
        if length is not None:
            table = table[: _checked_length(int(length), len(table))]
        return run_many(core, [table], [chain], *keys, parallel=parallel, **static)[0]
    x = jnp.asarray(log_likelihoods)
    _check_shape(x, chain)
    with jax.enable_x64(True):
        # Via uint32, as 64-bit NumPy integers under vmap are taken for 32 bits if JAX is set to these.
        n = jnp.asarray(len(x) if length is None else length).astype(jnp.uint32).astype(jnp.int32)
        kind = x.dtype if jnp.issubdtype(x.dtype, jnp.floating) else jnp.dtype(float)
        if inside is not None:
            cast = jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), chain)
            return inside(x.astype(kind), cast, n, parallel)
        result = core(x, chain, n, *keys, parallel=parallel, **static)[1]
        return jax.tree.map(lambda a: a.astype(kind) if a.dtype == jnp.float64 else a, result)


def checked(log_likelihoods: ArrayLike, chain: AnyChain) -> np.ndarray:
    """Doubles (num_samples, num_states); ValueError for anything else."""
    ll = np.asarray(log_likelihoods, dtype=np.float64)
    _check_shape(ll, chain)
    missing = np.isnan(ll)
    partly = missing & ~missing.all(1, keepdims=True)
    if partly.any():
        raise not_a_number("log_likelihoods", partly, " (a missing sample is NaN throughout)")
    return ll


def _failure(x: np.ndarray, chain: AnyChain) -> ValueError:
    """The exception for a recording without a finite log weight."""
    if np.isposinf(x).any():
        return not_a_number("log_likelihoods", np.isposinf(x))
    why: Core = durations.why_infeasible if isinstance(chain, DurationChain) else why_infeasible
    return why(x, chain)


def _check_shape(ll: Any, chain: AnyChain) -> None:
    if ll.ndim != 2 or 0 in ll.shape:
        raise ValueError(f"log_likelihoods: shape {ll.shape}, expected (num_samples, num_states)")
    num_samples, num_states = ll.shape
    if num_states != chain.num_states:
        raise ValueError(f"log_likelihoods: {num_states} states, expected the chain's {chain.num_states}")
    if chain.num_samples is not None and chain.num_samples != num_samples:
        raise ValueError(
            f"log_likelihoods: {num_samples} samples, expected {chain.num_samples} as in the chain"
        )


def _checked_length(length: int, num_samples: int, recording: str = "") -> int:
    if not 0 < length <= num_samples:
        raise ValueError(f"lengths: {length}{recording}, expected 1 to {num_samples}")
    return length


def recordings(
    log_likelihoods: Any, chain: AnyChain | Sequence[AnyChain], lengths: Sequence[int] | np.ndarray | None
) -> tuple[list[np.ndarray], list[AnyChain]]:
    """Checked tables and chains of several recordings."""
    tables = list(log_likelihoods)
    if lengths is not None:
        if len(lengths) != len(tables):
            raise ValueError(f"lengths: {len(lengths)} given, expected {len(tables)}, one a recording")
        tables = [
            ll[: _checked_length(n, len(ll), f" for recording {i}")]
            for i, (ll, n) in enumerate(zip(tables, lengths, strict=True))
        ]
    chains = [chain] * len(tables) if isinstance(chain, AnyChain) else list(chain)
    if len(chains) != len(tables):
        raise ValueError(f"chain: {len(chains)} given, expected {len(tables)}, one a recording")
    return [checked(ll, c) for ll, c in zip(tables, chains, strict=True)], chains


def run_many(core: Core, tables: Sequence[np.ndarray], chains: Sequence[Any], *keys: Any,
             parallel: bool | None = None, **static: Any) -> list[Any]:  # fmt: skip
    """Run a core on checked recordings, each padded to the ladder: one program per shape.

    Raises InfeasibleAlignment, and ValueError for +inf.
    """
    if parallel is None:
        parallel = jax.default_backend() != "cpu"
    padded = [_padded(chain, len(ll)) for ll, chain in zip(tables, chains, strict=True)]
    groups: dict[Any, list[int]] = {}
    for i, (ll, chain) in enumerate(zip(tables, padded, strict=True)):
        leaves, kind = jax.tree.flatten(chain)
        groups.setdefault((ladder(len(ll)), kind, *(np.shape(leaf) for leaf in leaves)), []).append(i)
    results: list[Any] = [None] * len(tables)
    for (size, *_), members in groups.items():
        whole = len(members) // TOGETHER * TOGETHER
        parts = [members[i : i + TOGETHER] for i in range(0, whole, TOGETHER)]
        parts += [[i] for i in members[whole:]]
        for part in parts:
            n = np.array([len(tables[i]) for i in part], np.int32)
            x = np.zeros((len(part), size, tables[part[0]].shape[1]))
            for row, i in zip(x, part, strict=True):
                row[: len(tables[i])] = tables[i]
            chain = jax.tree.map(lambda *leaves: np.stack(leaves), *(padded[i] for i in part))
            with jax.enable_x64(True):
                program = compiled(core, parallel, tuple(sorted(static.items())))
                totals, batch = jax.tree.map(np.asarray, program(x, chain, n, *keys))
            for j, i in enumerate(part):
                if not np.isfinite(totals[j]):
                    raise _failure(tables[i], chains[i])
                results[i] = _trimmed(jax.tree.map(lambda leaf, j=j: leaf[j], batch), len(tables[i]))
    return results


@cache
def compiled(core: Core, parallel: bool, static: tuple[tuple[str, Any], ...]) -> Core:
    """The core for several recordings as one program."""
    kws = dict(static, parallel=parallel)

    def run(x: jax.Array, chain: Any, n: jax.Array, *keys: jax.Array) -> Any:
        def one(args: tuple[Any, ...]) -> Any:
            return core(*args, *keys, **kws)

        return jax.vmap(one)((x, chain, n)) if parallel else jax.lax.map(one, (x, chain, n))

    return jax.jit(run)


def _padded(chain: AnyChain, num_samples: int) -> AnyChain:
    """The chain for a recording that is padded to the ladder."""
    if chain.num_samples is None:
        return chain
    more = ladder(num_samples) - num_samples
    assert isinstance(chain, Chain)
    bands = tuple(
        np.pad(band, ((0, more), (0, 0)), constant_values=-np.inf) if band.ndim == 2 else band
        for band in map(np.asarray, chain.bands)
    )
    return Chain.tree_unflatten(None, (bands, chain.log_initial, chain.log_final))


def _trimmed(result: Any, n: int) -> Any:
    """The result without the rows of padding, scalars as Python numbers."""
    if isinstance(result, tuple):
        return tuple(_trimmed(each, n) for each in result)
    if isinstance(result, Posterior):
        moves = tuple(move[: n - 1] for move in result.moves)
        return Posterior(float(result.log_evidence), result.smoothed[:n], moves)
    if isinstance(result, Filtered):
        return Filtered(float(result.log_evidence), result.filtered[:n])
    if isinstance(result, Alignment):
        return Alignment(result.starts.astype(np.int64), int(result.num_samples), float(result.log_prob))
    if isinstance(result, Alignments):
        return Alignments(result.starts.astype(np.int64), result.num_samples, result.log_prob)
    return float(result)


# Expectation maximisation.


def align(log_likelihoods: Sequence[np.ndarray], chains: Sequence[Chain]) -> list[AlignmentPosterior]:
    """`viterbi` and `smooth` of several recordings, as used by EM."""
    return [
        AlignmentPosterior(
            posterior.log_evidence, posterior.smoothed, posterior.moves, best.path, best.log_prob
        )
        for best, posterior in run_many(_align, *recordings(log_likelihoods, chains, None))
    ]


M = TypeVar("M")
LEAST_ITERATIONS = 6  # numerics: before the evidence may have settled


@dataclass(frozen=True)
class Learned(Generic[M]):
    """A fitted model, with every trial's most probable path and posterior under it."""

    model: M
    alignments: tuple[AlignmentPosterior, ...]
    converged: bool = False

    @property
    def log_evidence(self) -> float:
        """Log evidence of all trials [nats]."""
        return sum(each.log_evidence for each in self.alignments)


def em(model: M, tables: Callable[[M], tuple[Sequence[np.ndarray], Sequence[Chain]]],
       updated: Callable[[M, Sequence[np.ndarray]], M], max_iterations: int = 40,
       tolerance: float = 1e-3) -> Learned[M]:  # fmt: skip
    """Alternate expectation and maximisation until the log evidence changes by less than `tolerance` nats.

    The last step is an expectation. Trials of any lengths are pooled; emissions and durations are up to the
    caller (those by a network need no such driver, as `log_evidence` has a gradient). Dempster, Laird and
    Rubin, J. R. Stat. Soc. B 39, 1977; Rabiner, Proc. IEEE 77(2), 1989.

    Args:
        model: initial model.
        tables: maps a model to each trial's log-likelihoods (num_timesteps, num_states), -inf for impossible
            states, and its chain.
        updated: the M-step: a new model, given each trial's posterior state probabilities.
        max_iterations: limit, after which the result is unconverged.
        tolerance: nats.

    Returns:
        The final model.

    Raises:
        InfeasibleAlignment: a trial is too short for its states.
        ValueError: NaN.
    """
    before = -np.inf
    for iteration in range(1, max_iterations + 1):
        fit = Learned(model, tuple(align(*tables(model))))
        if iteration > LEAST_ITERATIONS and abs(fit.log_evidence - before) < tolerance:
            return Learned(model, fit.alignments, converged=True)
        if iteration < max_iterations:
            before = fit.log_evidence
            model = updated(model, [each.smoothed for each in fit.alignments])
    return fit
