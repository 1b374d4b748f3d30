"""The most probable path through states in a known order in JAX, by itself: a peer of hmmseg.hmm's kernels.

Rabiner, Proc. IEEE 77(2), 1989, in log space.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int


class Path(NamedTuple):
    """Most probable alignment: `path` (num_timesteps,) of state indices and its log weight."""

    path: Int[Array, " timesteps"]
    log_prob: Float[Array, ""]


def viterbi(log_likelihoods: Array, log_stay: Array, log_advance: Array) -> Path:
    """Path of log likelihoods (num_timesteps, num_states) from the first state to the last.

    `log_stay`: (num_states,), or one such row a transition; `log_advance`: the same, one narrower, from k to
    k + 1. What does not vary is never written out. In single precision the best weight is taken out at every
    sample: without, weights grow with the recording and their rounding moves labels. The log weight is -inf
    where there is no path.
    """
    ll, num_states = log_likelihoods, log_likelihoods.shape[1]
    single, none = ll.dtype == jnp.float32, jnp.array(-jnp.inf, ll.dtype)
    advance = jnp.pad(log_advance, [(0, 0)] * (log_advance.ndim - 1) + [(1, 0)], constant_values=-jnp.inf)
    varying = [band if band.ndim == 2 else None for band in (log_stay, advance)]

    def step(carry, inputs):
        delta, taken = carry  # one state more, before the first, that no path comes from
        row, stay_now, advance_now = inputs
        best = delta[1:] + (log_stay if stay_now is None else stay_now)
        arrives = delta[:-1] + (advance if advance_now is None else advance_now)
        jump = arrives > best
        best = jnp.where(jump, arrives, best) + row
        if single:
            top = lax.stop_gradient(jnp.max(best))
            top = jnp.where(jnp.isneginf(top), 0.0, top)
            best, taken = best - top, taken + top.astype(float)
        return (lax.pad(best, none, ((1, 0, 0),)), taken), jump

    first = jnp.full(num_states + 1, none).at[1].set(ll[0, 0])
    (delta, taken), jumps = lax.scan(step, (first, jnp.zeros((), float)), (ll[1:], *varying))

    def back(k, jump):
        k = k - jump[k].astype(jnp.int32)
        return k, k

    last = jnp.int32(num_states - 1)
    _, path = lax.scan(back, last, jumps, reverse=True)
    return Path(jnp.append(path, last), taken + delta[-1].astype(float))
