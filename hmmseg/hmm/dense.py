"""Hidden Markov model with an arbitrary transition matrix, the alternative to a forced order.

A recording that departs from its task is explained better by free switching among the same states; comparing
log evidences needs this general model. Conventions as in hmmseg.hmm.inference (Rabiner, Proc. IEEE 77(2),
1989).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from hmmseg.hmm.inference import ladder
from hmmseg.hmm.recursions import argmax, log_sum, row

BLOCK = 16_384  # numerics: rows per call, which bounds the memory for a long recording


@dataclass(frozen=True)
class Path:
    """Most probable states `path` (num_samples,) and their log weight."""

    path: np.ndarray
    log_prob: float


def log_evidence(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> float:
    """Log of the summed weight of all state paths.

    Args:
        log_likelihoods: (num_samples, num_states).
        log_initial: (num_states,).
        log_transition: (num_states, num_states), [i, j] from i to j.

    Returns:
        nats; -inf if no path exists (without an order, no single state is at fault).

    Raises:
        ValueError: NaN, wrong shapes.
    """
    weights, blocks, transition = _start(log_likelihoods, log_initial, log_transition)
    with jax.enable_x64(True):
        for x, n in blocks:
            weights = np.asarray(_pass(weights, x, transition, n, best=False)[0])
    return float(np.logaddexp.reduce(weights))


def viterbi(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> Path:
    """Most probable state path; arguments as of `log_evidence`. ValueError also if no path is possible."""
    weights, blocks, transition = _start(log_likelihoods, log_initial, log_transition)
    pointers = []
    with jax.enable_x64(True):
        for x, n in blocks:
            weights, sources = jax.tree.map(np.asarray, _pass(weights, x, transition, n, best=True))
            pointers.append((sources, n))
        if not np.isfinite(weights.max()):
            raise ValueError("no state path has any probability")
        k = weights.argmax()
        pieces = [np.array([k])]
        for sources, n in reversed(pointers):
            piece = np.asarray(_back(sources, np.int32(k), n))[:n]
            pieces.append(piece)
            k = piece[0]
    return Path(np.concatenate(pieces[::-1]).astype(np.int64), float(weights.max()))


def _start(*arrays: ArrayLike) -> tuple[np.ndarray, Iterator[tuple[np.ndarray, np.int32]], np.ndarray]:
    """Weights (num_states,) at the first row, padded blocks of the other rows, and the transitions."""
    ll, initial, transition = (np.asarray(a, dtype=np.float64) for a in arrays)
    num_states = ll.shape[-1]
    expected = ((len(ll), num_states), (num_states,), (num_states, num_states))
    names = ("log_likelihoods", "log_initial", "log_transition")
    for name, array, shape in zip(names, (ll, initial, transition), expected, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
        if np.isnan(array).any():
            raise ValueError(f"{name}: NaN at {np.argwhere(np.isnan(array))[0].tolist()}")

    def blocks() -> Iterator[tuple[np.ndarray, np.int32]]:
        for at in range(1, len(ll), BLOCK):
            rows = ll[at : at + BLOCK]
            padded = np.zeros((min(ladder(len(rows)), BLOCK), num_states))
            padded[: len(rows)] = rows
            yield padded, np.int32(len(rows))

    return initial + ll[0], blocks(), transition


@partial(jax.jit, static_argnames="best")
def _pass(weights: Array, x: Array, transition: Array, n: Array, best: bool) -> tuple[Array, Array]:
    """Weights (num_states,) of all paths to each state, or of the best, n rows later, and back-pointers."""

    def step(t: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        ways, sources = carry[0][:, None] + transition, carry[1]
        if not best:
            return log_sum(ways, 0) + row(x, t), sources
        sources = lax.dynamic_update_index_in_dim(sources, argmax(ways).astype(sources.dtype), t, 0)
        return ways.max(0) + row(x, t), sources

    sources = jnp.zeros(x.shape if best else (), jnp.uint8 if x.shape[1] <= 256 else jnp.int32)
    return lax.fori_loop(jnp.int32(0), n, step, (weights, sources))


@jax.jit
def _back(sources: Array, k: Array, n: Array) -> Array:
    """States before each of n rows, on the path that is in state k at the last of them."""

    def step(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        t, (k, path) = n - 1 - i, carry
        k = row(sources, t)[k].astype(jnp.int32)
        return k, path.at[t].set(k)

    return lax.fori_loop(jnp.int32(0), n, step, (k, jnp.zeros(len(sources), jnp.int32)))[1]
