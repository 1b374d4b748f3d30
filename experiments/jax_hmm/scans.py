"""The recursions of experiments.jax_hmm.alignment in JAX; whoever calls them has checked shapes."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


class Path(NamedTuple):
    """Most probable alignment: `path` (num_timesteps,) of subtask indices and its log weight."""

    path: Int[Array, " timesteps"]
    log_prob: Float[Array, ""]


class Filtered(NamedTuple):
    """On-line view: `log_filtered` [t, k] = log p(subtask k at t | samples up to t), normalised.

    `log_evidence` sums the weights of all complete paths.
    """

    log_evidence: Float[Array, ""]
    log_filtered: Float[Array, "timesteps subtasks"]


class Posterior(NamedTuple):
    """Posterior over alignments given the whole recording, in logs.

    `log_smoothed` [t, k]: subtask k at sample t. `log_advance` [t, k]: subtask k ends and k + 1
    starts between the samples t and t + 1; `log_skip` the same for k + 2, k + 3, ...
    """

    log_evidence: Float[Array, ""]
    log_smoothed: Float[Array, "timesteps subtasks"]
    log_advance: Float[Array, "timesteps-1 subtasks-1"]
    log_skip: tuple[Float[Array, "timesteps-1 _"], ...] = ()


class Weights(NamedTuple):
    """A recording and its chain, as the recursions take them."""

    log_likelihoods: Array  # (num_timesteps, num_subtasks)
    bands: tuple[Array, ...]  # band d: (num_timesteps - 1, num_subtasks - d), or one row for all
    log_initial: Array
    log_final: Array
    valid: Array | None  # (num_timesteps,): what is no padding; None: everything


def unfolded(chain: Weights) -> Weights:
    """One row of weights a transition, and padding made neutral: weight 1, stay for sure."""
    ll, steps = chain.log_likelihoods, chain.log_likelihoods.shape[0] - 1
    bands = [jnp.broadcast_to(band, (steps, band.shape[-1])) for band in chain.bands]
    if chain.valid is not None:
        valid = chain.valid[:, None]
        ll = jnp.where(valid, ll, 0.0)
        bands = [jnp.where(valid[1:], b, -jnp.inf if d else 0.0) for d, b in enumerate(bands)]
    return Weights(ll, tuple(bands), chain.log_initial, chain.log_final, None)


def log_sum_exp(x: Float[Array, "*_"], axis: int) -> Float[Array, "*_"]:
    """Log of a sum of exponentials that keeps values and gradients finite among -inf."""
    top = lax.stop_gradient(jnp.max(x, axis, keepdims=True))
    top = jnp.where(jnp.isneginf(top), 0.0, top)
    total = jnp.sum(jnp.exp(x - top), axis)
    positive = total > 0
    value = jnp.log(jnp.where(positive, total, 1.0)) + jnp.squeeze(top, axis)
    return jnp.where(positive, value, jnp.where(jnp.isnan(total), jnp.nan, -jnp.inf))


def _arrivals(alpha: Array, bands: tuple[Array, ...]) -> Array:
    """Weights (num_bands, num_subtasks) of arriving in each subtask from d subtasks before."""
    empty = jnp.full(alpha.shape[0], -jnp.inf)
    return jnp.stack([empty.at[d:].set(alpha[: alpha.shape[0] - d] + band) if band.size else empty
                      for d, band in enumerate(bands)])  # fmt: skip


def _departures(beta: Array, bands: tuple[Array, ...]) -> Array:
    """Weights (num_bands, num_subtasks) of leaving each subtask for d subtasks on."""
    empty = jnp.full(beta.shape[0], -jnp.inf)
    return jnp.stack([empty.at[: beta.shape[0] - d].set(band + beta[d:]) if band.size else empty
                      for d, band in enumerate(bands)])  # fmt: skip


def forward(chain: Weights) -> Array:
    """Log weights (num_timesteps, num_subtasks) of all paths up to each sample."""

    def step(alpha, inputs):
        bands, ll = inputs
        alpha = log_sum_exp(_arrivals(alpha, bands), 0) + ll
        return alpha, alpha

    first = chain.log_initial + chain.log_likelihoods[0]
    _, rest = lax.scan(step, first, (chain.bands, chain.log_likelihoods[1:]))
    return jnp.concatenate([first[None], rest])


def backward(chain: Weights) -> Array:
    """Log weights (num_timesteps, num_subtasks) of all that follows each sample."""

    def step(beta, inputs):
        bands, ll = inputs
        beta = log_sum_exp(_departures(beta + ll, bands), 0)
        return beta, beta

    inputs = (chain.bands, chain.log_likelihoods[1:])
    _, rest = lax.scan(step, chain.log_final, inputs, reverse=True)
    return jnp.concatenate([rest, chain.log_final[None]])


@jax.jit
def filtered(chain: Weights) -> Filtered:
    """What each sample says together with those before it."""
    chain = unfolded(chain)
    alpha = forward(chain)
    norm = log_sum_exp(alpha, 1)[:, None]
    filtered = alpha - jnp.where(jnp.isneginf(norm), 0.0, norm)
    return Filtered(log_sum_exp(alpha[-1] + chain.log_final, 0), filtered)


@jax.jit
def smoothed(chain: Weights) -> Posterior:
    """Posterior given the whole recording."""
    chain = unfolded(chain)
    alpha, beta = forward(chain), backward(chain)
    log_evidence = log_sum_exp(alpha[-1] + chain.log_final, 0)
    norm = jnp.where(jnp.isneginf(log_evidence), 0.0, log_evidence)
    arrive = beta[1:] + chain.log_likelihoods[1:]
    num_subtasks = alpha.shape[1]
    moves = [alpha[:-1, : num_subtasks - d] + band + arrive[:, d:] - norm if band.size else band
             for d, band in enumerate(chain.bands)]  # fmt: skip
    return Posterior(log_evidence, alpha + beta - norm, moves[1], tuple(moves[2:]))


@jax.jit
def best_path(chain: Weights) -> Path:
    """Weights are carried with one -inf for each band before the first state: arriving is a slice.

    Bands that do not vary are never written out. In single precision the best weight is taken out at every
    sample: without, weights grow with the recording and their rounding moves labels.
    """
    ll, before = chain.log_likelihoods, len(chain.bands) - 1
    num_subtasks, single = ll.shape[1], ll.dtype == jnp.float32
    none = jnp.array(-jnp.inf, ll.dtype)

    def ahead(band: Array) -> Array:
        """As wide as the chain, -inf for the states that the band does not reach."""
        missing = [(0, 0)] * (band.ndim - 1) + [(num_subtasks - band.shape[-1], 0)]
        return jnp.pad(band, missing, constant_values=-jnp.inf)

    bands = [ahead(band) for band in chain.bands]
    varying = [band if band.ndim == 2 else None for band in bands]

    def step(carry, inputs):
        delta, taken = carry
        row, now, there = inputs
        weights = [band if each is None else each for band, each in zip(bands, now, strict=True)]
        best, jump = delta[before:] + weights[0], None
        for d, weight in enumerate(weights[1:], 1):
            arrives = delta[before - d : before - d + num_subtasks] + weight
            further = arrives > best
            jump = further if jump is None else jnp.where(further, jnp.uint8(d), jump.astype(jnp.uint8))
            best = jnp.where(further, arrives, best)
        jump = jnp.zeros(num_subtasks, bool) if jump is None else jump
        best = best + row
        if there is not None:
            best, jump = jnp.where(there, best, delta[before:]), jnp.where(there, jump, jnp.zeros_like(jump))
        if single:
            top = lax.stop_gradient(jnp.max(best))
            top = jnp.where(jnp.isneginf(top), 0.0, top)
            best, taken = best - top, taken + top.astype(float)
        return (lax.pad(best, none, ((before, 0, 0),)), taken), jump

    first = lax.pad(chain.log_initial + ll[0], none, ((before, 0, 0),))
    inputs = (ll[1:], varying, None if chain.valid is None else chain.valid[1:])
    (delta, taken), jumps = lax.scan(step, (first, jnp.zeros((), float)), inputs)
    ends = delta[before:] + chain.log_final
    last = jnp.argmax(ends).astype(jnp.int32)

    def back(k, jump):
        k = k - jump[k].astype(jnp.int32)
        return k, k

    _, path = lax.scan(back, last, jumps, reverse=True)
    return Path(jnp.append(path, last), taken + jnp.max(ends).astype(float))


def _sample(key: Array, chain: Weights, num_samples: int) -> tuple[Array, Array]:
    chain = unfolded(chain)
    alpha = forward(chain)
    end = alpha[-1] + chain.log_final
    arrivals = jax.vmap(_arrivals)(alpha[:-1], chain.bands)  # (T - 1, num_bands, num_subtasks)

    def draw(key):
        key_last, key_rest = jax.random.split(key)
        last = jax.random.categorical(key_last, end)

        def back(k, inputs):
            arrival, key = inputs
            k = k - jax.random.categorical(key, arrival[:, k])
            return k, k

        keys = jax.random.split(key_rest, arrivals.shape[0])
        _, path = lax.scan(back, last, (arrivals, keys), reverse=True)
        return jnp.append(path, last)

    return jax.vmap(draw)(jax.random.split(key, num_samples)), log_sum_exp(end, 0)


draw = jax.jit(_sample, static_argnums=2)
