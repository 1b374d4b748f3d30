"""Hidden Markov model with any dense transition matrix: the alternative to a forced order.

A recording that does not follow its task is explained better by free switching among the same
states; comparing log evidences needs this general model. Same conventions and recursions as
hmmseg.hmm.banded (Rabiner, Proc. IEEE 77(2), 1989).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Shaped

from hmmseg.hmm.banded import Path, log_sum_exp


def _neutral(log_likelihoods: Array, num_valid: Array | int | None) -> tuple[Array, Array]:
    """Log-likelihoods, and which steps t -> t + 1 are real and not padding."""
    num_timesteps = log_likelihoods.shape[0]
    n = num_timesteps if num_valid is None else num_valid
    return log_likelihoods, jnp.arange(1, num_timesteps) < n


@jax.jit
def _log_evidence(log_likelihoods, log_initial, log_transition, num_valid):
    ll, real = _neutral(log_likelihoods, num_valid)

    def step(alpha, inputs):
        ll, real = inputs
        moved = log_sum_exp(alpha[:, None] + log_transition, 0) + ll
        return jnp.where(real, moved, alpha), None

    alpha, _ = lax.scan(step, log_initial + ll[0], (ll[1:], real))
    return log_sum_exp(alpha, 0)


@jax.jit
def _best(log_likelihoods, log_initial, log_transition, num_valid):
    ll, real = _neutral(log_likelihoods, num_valid)
    states = jnp.arange(ll.shape[1])

    def step(delta, inputs):
        ll, real = inputs
        scores = delta[:, None] + log_transition
        source = jnp.where(real, jnp.argmax(scores, 0), states)
        return jnp.where(real, jnp.max(scores, 0) + ll, delta), source

    delta, sources = lax.scan(step, log_initial + ll[0], (ll[1:], real))
    last = jnp.argmax(delta)

    def back(k, source):
        return source[k], source[k]

    _, path = lax.scan(back, last, sources, reverse=True)
    return Path(jnp.append(path, last), jnp.max(delta))


def _checked(log_likelihoods, log_initial, log_transition) -> tuple[Array, Array, Array]:
    ll, initial, transition = (jnp.asarray(a, float) for a in (log_likelihoods, log_initial, log_transition))
    arrays = ll, initial, transition
    num_states = arrays[0].shape[1]
    expected = (arrays[0].shape, (num_states,), (num_states, num_states))
    for name, array, shape in zip(("log_likelihoods", "log_initial", "log_transition"), arrays, expected,
                                  strict=True):  # fmt: skip
        if array.shape != shape:
            raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
        if not isinstance(array, Tracer) and bool(jnp.any(jnp.isnan(array))):
            raise ValueError(f"{name}: NaN at {np.argwhere(np.isnan(np.asarray(array)))[0].tolist()}")
    return arrays


def log_evidence(
    log_likelihoods: Shaped[ArrayLike, "timesteps states"],
    log_initial: Shaped[ArrayLike, "*_"],
    log_transition: Shaped[ArrayLike, "*_"],
    num_valid: int | Int[ArrayLike, ""] | None = None,
) -> Float[Array, ""]:
    """Log of the summed weight of all state paths.

    `log_initial` (num_states,), `log_transition` [i, j] from i to j. Rows from `num_valid` on are
    padding. -inf where no path exists (a state model has no task to starve). ValueError on NaN.
    """
    return _log_evidence(*_checked(log_likelihoods, log_initial, log_transition), num_valid)


def viterbi(
    log_likelihoods: Shaped[ArrayLike, "timesteps states"],
    log_initial: Shaped[ArrayLike, "*_"],
    log_transition: Shaped[ArrayLike, "*_"],
    num_valid: int | Int[ArrayLike, ""] | None = None,
) -> Path:
    """Most probable state path; ValueError where none is possible, or on NaN."""
    best = _best(*_checked(log_likelihoods, log_initial, log_transition), num_valid)
    if not isinstance(best.log_prob, Tracer) and not np.isfinite(best.log_prob):
        raise ValueError("no state path has any probability")
    return best
