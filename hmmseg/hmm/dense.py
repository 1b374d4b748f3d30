"""Hidden Markov model with any transition matrix: the alternative to a forced order.

A recording that does not follow its task is explained better by free switching among the same states;
comparing log evidences needs this general model. Same conventions as hmmseg.hmm.inference (Rabiner,
Proc. IEEE 77(2), 1989).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import ArrayLike

from hmmseg.hmm.inference import ladder
from hmmseg.hmm.recursions import NEVER, argmax, log_sum, row


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
    return float(_run(_evidence, log_likelihoods, log_initial, log_transition))


def viterbi(log_likelihoods: ArrayLike, log_initial: ArrayLike, log_transition: ArrayLike) -> Path:
    """Most probable state path; arguments as of `log_evidence`. ValueError where none is possible, too."""
    path, log_prob = _run(_path, log_likelihoods, log_initial, log_transition)
    if not np.isfinite(log_prob):
        raise ValueError("no state path has any probability")
    return Path(path[: len(np.asarray(log_likelihoods))].astype(np.int64), float(log_prob))


def _run(core: Callable, *arrays: ArrayLike):  # type: ignore[no-untyped-def]
    ll, initial, transition = (np.asarray(a, dtype=np.float64) for a in arrays)
    num_states = ll.shape[-1]
    expected = ((len(ll), num_states), (num_states,), (num_states, num_states))
    names = ("log_likelihoods", "log_initial", "log_transition")
    for name, array, shape in zip(names, (ll, initial, transition), expected, strict=True):
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
        if np.isnan(array).any():
            raise ValueError(f"{name}: NaN at {np.argwhere(np.isnan(array))[0].tolist()}")
    x = np.zeros((ladder(len(ll)), num_states))
    x[: len(ll)] = ll
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _compiled(core)(x, initial, transition, np.int32(len(ll))))


@cache
def _compiled(core: Callable) -> Callable:
    return jax.jit(core)


def _evidence(x: Array, initial: Array, transition: Array, n: Array) -> Array:
    def step(t: Array, weights: Array) -> Array:
        return log_sum(weights[:, None] + transition, 0) + row(x, t)

    return log_sum(lax.fori_loop(jnp.int32(1), n, step, initial + x[0]), 0)


def _path(x: Array, initial: Array, transition: Array, n: Array) -> tuple[Array, Array]:
    def step(t: Array, table: Array) -> Array:
        best = (row(table, t - 1)[:, None] + transition).max(0) + row(x, t)
        return lax.dynamic_update_index_in_dim(table, best, t, 0)

    first = jnp.full(x.shape, NEVER).at[0].set(initial + x[0])
    table = lax.fori_loop(jnp.int32(1), n, step, first)
    last = argmax(row(table, n - 1))

    def back(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        t, (k, path) = n - 2 - i, carry
        k = argmax(row(table, t) + transition[:, k])
        return k, path.at[t].set(k)

    path = jnp.zeros(len(x), jnp.int32).at[n - 1].set(last)
    return lax.fori_loop(jnp.int32(0), n - 1, back, (last, path))[1], row(table, n - 1)[last]
