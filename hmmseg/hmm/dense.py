"""Hidden Markov model with any transition matrix: the alternative to a forced order.

A recording that does not follow its task is explained better by free switching among the same states;
comparing log evidences needs this general model. Same conventions as hmmseg.hmm.inference (Rabiner,
Proc. IEEE 77(2), 1989).
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

BLOCK = 16_384  # numerics: rows that one call takes, so that little is made of a long recording at once


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
        nats; -inf where no path exists, as a model without an order has no state to starve.

    Raises:
        ValueError: NaN, wrong shapes.
    """
    weights, blocks, transition = _start(log_likelihoods, log_initial, log_transition)
    with jax.enable_x64(True):
        for x, n in blocks:
            weights = np.asarray(_pass(weights, x, transition, n, best=False)[0])
    return float(np.logaddexp.reduce(weights))


def viterbi(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> Path:
    """Most probable state path; arguments as of `log_evidence`. ValueError where none is possible, too."""
    weights, blocks, transition = _start(log_likelihoods, log_initial, log_transition)
    taken = []
    with jax.enable_x64(True):
        for x, n in blocks:
            weights, sources = jax.tree.map(np.asarray, _pass(weights, x, transition, n, best=True))
            taken.append((sources, n))
        if not np.isfinite(weights.max()):
            raise ValueError("no state path has any probability")
        k = weights.argmax()
        pieces = [np.array([k])]
        for sources, n in reversed(taken):
            piece = np.asarray(_back(sources, np.int32(k), n))[:n]
            pieces.append(piece)
            k = piece[0]
    return Path(np.concatenate(pieces[::-1]).astype(np.int64), float(weights.max()))


def _start(*arrays: ArrayLike) -> tuple[np.ndarray, Iterator[tuple[np.ndarray, np.int32]], np.ndarray]:
    """Weights (num_states,) at the first row; further rows, in padded blocks, and their numbers."""
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
    """Weights (num_states,) of all paths to each state, or of the best, n rows further on.

    Also from where the best came to each row.
    """

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
    """States before each of n rows, of the path that is in state k at the last of them."""

    def step(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        t, (k, path) = n - 1 - i, carry
        k = row(sources, t)[k].astype(jnp.int32)
        return k, path.at[t].set(k)

    return lax.fori_loop(jnp.int32(0), n, step, (k, jnp.zeros(len(sources), jnp.int32)))[1]
