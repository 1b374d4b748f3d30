"""Forced alignment of a recording to a known order of subtasks, as a band-limited HMM.

Free functions on plain log-likelihoods (num_timesteps, num_subtasks). From one sample to the next
a path stays in its subtask, advances by one, or (where subtasks are optional) skips further:

- `log_stay` (num_timesteps - 1, num_subtasks), or (num_subtasks,) where it does not vary in time;
- `log_advance` (num_timesteps - 1, num_subtasks - 1) or (num_subtasks - 1,): from k to k + 1;
- `log_skip`: None, an array (num_timesteps - 1, num_subtasks - 2) or (num_subtasks - 2,) from k
  to k + 2, or a tuple of arrays for k + 2, k + 3, ...

Entry [t, k] belongs to leaving subtask k between the samples t and t + 1. These are log weights and
need not be normalised. A path starts in subtask 0 and ends in the last one unless `log_initial` or
`log_final` (num_subtasks,) say otherwise.

With `num_valid`, rows from that one on are padding and change nothing; it may be traced, so that
recordings of many lengths share one compilation. Every function can be jitted, vmapped and
differentiated; called with concrete arrays it raises InfeasibleAlignment where no path exists and
ValueError on NaN, under tracing the log evidence is -inf (or NaN) instead.

Recursions: Rabiner, Proc. IEEE 77(2), 1989, in log space; forward filtering, backward sampling:
Scott, J. Am. Stat. Assoc. 97, 2002.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PRNGKeyArray, Shaped

from hmmseg.hmm.chain import InfeasibleAlignment

Skip = Shaped[ArrayLike, "*_"] | tuple[Shaped[ArrayLike, "*_"], ...] | None


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


class _Chain(NamedTuple):
    log_likelihoods: Array  # (num_timesteps, num_subtasks)
    bands: tuple[Array, ...]  # band d: (num_timesteps - 1, num_subtasks - d)
    log_initial: Array
    log_final: Array


def _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final) -> _Chain:
    """Check shapes, broadcast, and neutralise padding: weight 1, stay for sure."""
    ll = jnp.asarray(log_likelihoods, float)
    if ll.ndim != 2 or 0 in ll.shape:
        raise ValueError(f"log_likelihoods: shape {ll.shape}, expected (num_timesteps, num_subtasks)")
    num_timesteps, num_subtasks = ll.shape
    skips = () if log_skip is None else log_skip if isinstance(log_skip, tuple) else (log_skip,)
    bands = []
    for d, band in enumerate((log_stay, log_advance, *skips)):
        band = jnp.asarray(band, float)
        width = max(num_subtasks - d, 0)
        if band.shape not in ((width,), (num_timesteps - 1, width)):
            name = ("log_stay", "log_advance")[d] if d < 2 else f"log_skip[{d - 2}]"
            raise ValueError(
                f"{name}: shape {band.shape}, expected {(num_timesteps - 1, width)} or {(width,)}"
            )
        bands.append(jnp.broadcast_to(band, (num_timesteps - 1, width)))
    ends = []
    for name, end, index in (("log_initial", log_initial, 0), ("log_final", log_final, num_subtasks - 1)):
        if end is None:
            end = jnp.full(num_subtasks, -jnp.inf).at[index].set(0.0)
        end = jnp.asarray(end, float)
        if end.shape != (num_subtasks,):
            raise ValueError(f"{name}: shape {end.shape}, expected {(num_subtasks,)}")
        ends.append(end)
    if num_valid is not None:
        valid = jnp.arange(num_timesteps)[:, None] < num_valid
        ll = jnp.where(valid, ll, 0.0)
        bands = [jnp.where(valid[1:], b, -jnp.inf if d else 0.0) for d, b in enumerate(bands)]
    return _Chain(ll, tuple(bands), ends[0], ends[1])


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


def _forward(chain: _Chain) -> Array:
    def step(alpha, inputs):
        bands, ll = inputs
        alpha = log_sum_exp(_arrivals(alpha, bands), 0) + ll
        return alpha, alpha

    first = chain.log_initial + chain.log_likelihoods[0]
    _, rest = lax.scan(step, first, (chain.bands, chain.log_likelihoods[1:]))
    return jnp.concatenate([first[None], rest])


def _backward(chain: _Chain) -> Array:
    def step(beta, inputs):
        bands, ll = inputs
        beta = log_sum_exp(_departures(beta + ll, bands), 0)
        return beta, beta

    inputs = (chain.bands, chain.log_likelihoods[1:])
    _, rest = lax.scan(step, chain.log_final, inputs, reverse=True)
    return jnp.concatenate([rest, chain.log_final[None]])


@jax.jit
def _filter(chain: _Chain) -> Filtered:
    alpha = _forward(chain)
    norm = log_sum_exp(alpha, 1)[:, None]
    filtered = alpha - jnp.where(jnp.isneginf(norm), 0.0, norm)
    return Filtered(log_sum_exp(alpha[-1] + chain.log_final, 0), filtered)


@jax.jit
def _smooth(chain: _Chain) -> Posterior:
    alpha, beta = _forward(chain), _backward(chain)
    log_evidence = log_sum_exp(alpha[-1] + chain.log_final, 0)
    norm = jnp.where(jnp.isneginf(log_evidence), 0.0, log_evidence)
    arrive = beta[1:] + chain.log_likelihoods[1:]
    num_subtasks = alpha.shape[1]
    moves = [alpha[:-1, : num_subtasks - d] + band + arrive[:, d:] - norm if band.size else band
             for d, band in enumerate(chain.bands)]  # fmt: skip
    return Posterior(log_evidence, alpha + beta - norm, moves[1], tuple(moves[2:]))


@jax.jit
def _best(chain: _Chain) -> Path:
    def step(delta, inputs):
        bands, ll = inputs
        arrivals = _arrivals(delta, bands)
        return jnp.max(arrivals, 0) + ll, jnp.argmax(arrivals, 0)

    first = chain.log_initial + chain.log_likelihoods[0]
    delta, jumps = lax.scan(step, first, (chain.bands, chain.log_likelihoods[1:]))
    last = jnp.argmax(delta + chain.log_final)

    def back(k, jump):
        k = k - jump[k]
        return k, k

    _, path = lax.scan(back, last, jumps, reverse=True)
    return Path(jnp.append(path, last), jnp.max(delta + chain.log_final))


def _sample(key: Array, chain: _Chain, num_samples: int) -> tuple[Array, Array]:
    alpha = _forward(chain)
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


_sample_jit = jax.jit(_sample, static_argnums=2)


def _raise_if_impossible(total: Array, chain: _Chain, num_valid) -> None:
    if isinstance(total, Tracer) or np.isfinite(total):
        return
    n = chain.log_likelihoods.shape[0] if num_valid is None else int(num_valid)
    chain = chain._replace(
        log_likelihoods=chain.log_likelihoods[:n], bands=tuple(band[: n - 1] for band in chain.bands)
    )
    for name, value in chain._asdict().items():
        for array in value if isinstance(value, tuple) else (value,):
            array = np.asarray(array)
            if np.isnan(array).any() or np.isposinf(array).any():
                where = np.argwhere(np.isnan(array) | np.isposinf(array))[0].tolist()
                raise ValueError(f"{name}: NaN or +inf at {where}, expected numbers or -inf")
    reached = np.isfinite(np.asarray(_forward(chain))).any(0)
    deepest = int(np.flatnonzero(reached).max(initial=-1))
    last = reached.size - 1
    if deepest == last:
        raise InfeasibleAlignment(last, "reached, but cannot be held to the end")
    starving = deepest + 1
    if not np.isfinite(np.asarray(chain.log_likelihoods)[:, starving]).any():
        raise InfeasibleAlignment(starving, "no sample is possible under it")
    if chain.log_likelihoods.shape[0] <= starving:
        raise InfeasibleAlignment(starving, f"{n} samples are too few")
    raise InfeasibleAlignment(starving, "no path reaches it")


def viterbi(
    log_likelihoods: Shaped[ArrayLike, "timesteps subtasks"],
    log_stay: Shaped[ArrayLike, "*_"],
    log_advance: Shaped[ArrayLike, "*_"],
    log_skip: Skip = None,
    *,
    num_valid: int | Int[ArrayLike, ""] | None = None,
    log_initial: Shaped[ArrayLike, " subtasks"] | None = None,
    log_final: Shaped[ArrayLike, " subtasks"] | None = None,
) -> Path:
    """Most probable alignment; raises InfeasibleAlignment or ValueError (see the module)."""
    chain = _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final)
    best = _best(chain)
    _raise_if_impossible(best.log_prob, chain, num_valid)
    return best


def forward(
    log_likelihoods: Shaped[ArrayLike, "timesteps subtasks"],
    log_stay: Shaped[ArrayLike, "*_"],
    log_advance: Shaped[ArrayLike, "*_"],
    log_skip: Skip = None,
    *,
    num_valid: int | Int[ArrayLike, ""] | None = None,
    log_initial: Shaped[ArrayLike, " subtasks"] | None = None,
    log_final: Shaped[ArrayLike, " subtasks"] | None = None,
) -> Filtered:
    """Filtered probabilities and log evidence; raises as the module says.

    An unfinished recording has evidence only if `log_final` lets it end early (zeros).
    """
    chain = _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final)
    filtered = _filter(chain)
    _raise_if_impossible(filtered.log_evidence, chain, num_valid)
    return filtered


def forward_backward(
    log_likelihoods: Shaped[ArrayLike, "timesteps subtasks"],
    log_stay: Shaped[ArrayLike, "*_"],
    log_advance: Shaped[ArrayLike, "*_"],
    log_skip: Skip = None,
    *,
    num_valid: int | Int[ArrayLike, ""] | None = None,
    log_initial: Shaped[ArrayLike, " subtasks"] | None = None,
    log_final: Shaped[ArrayLike, " subtasks"] | None = None,
) -> Posterior:
    """Smoothed subtask and boundary probabilities; raises as the module says."""
    chain = _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final)
    posterior = _smooth(chain)
    _raise_if_impossible(posterior.log_evidence, chain, num_valid)
    return posterior


def sample_alignments(
    key: PRNGKeyArray,
    log_likelihoods: Shaped[ArrayLike, "timesteps subtasks"],
    log_stay: Shaped[ArrayLike, "*_"],
    log_advance: Shaped[ArrayLike, "*_"],
    num_samples: int,
    log_skip: Skip = None,
    *,
    num_valid: int | Int[ArrayLike, ""] | None = None,
    log_initial: Shaped[ArrayLike, " subtasks"] | None = None,
    log_final: Shaped[ArrayLike, " subtasks"] | None = None,
) -> Int[Array, "samples timesteps"]:
    """Independent exact posterior draws of whole alignments; raises as the module says."""
    chain = _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final)
    paths, log_evidence = _sample_jit(key, chain, num_samples)
    _raise_if_impossible(log_evidence, chain, num_valid)
    return paths
