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

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Int, PRNGKeyArray, Shaped

from experiments.jax_hmm.scans import Filtered, Path, Posterior, Weights, best_path, draw, filtered, smoothed
from hmmseg.hmm.chain import Chain, why_infeasible

Skip = Shaped[ArrayLike, "*_"] | tuple[Shaped[ArrayLike, "*_"], ...] | None


def _chain(log_likelihoods, log_stay, log_advance, log_skip, num_valid, log_initial, log_final) -> Weights:
    """Check shapes; numbers in single precision stay so, all else becomes JAX's default."""
    ll = jnp.asarray(log_likelihoods)
    ll = ll if ll.dtype == jnp.float32 else ll.astype(float)
    if ll.ndim != 2 or 0 in ll.shape:
        raise ValueError(f"log_likelihoods: shape {ll.shape}, expected (num_timesteps, num_subtasks)")
    num_timesteps, num_subtasks = ll.shape
    skips = () if log_skip is None else log_skip if isinstance(log_skip, tuple) else (log_skip,)
    bands = []
    for d, band in enumerate((log_stay, log_advance, *skips)):
        band = jnp.asarray(band, ll.dtype)
        width = max(num_subtasks - d, 0)
        if band.shape not in ((width,), (num_timesteps - 1, width)):
            name = ("log_stay", "log_advance")[d] if d < 2 else f"log_skip[{d - 2}]"
            raise ValueError(
                f"{name}: shape {band.shape}, expected {(num_timesteps - 1, width)} or {(width,)}"
            )
        bands.append(band)
    ends = []
    for name, end, index in (("log_initial", log_initial, 0), ("log_final", log_final, num_subtasks - 1)):
        if end is None:
            end = jnp.full(num_subtasks, -jnp.inf).at[index].set(0.0)
        end = jnp.asarray(end, ll.dtype)
        if end.shape != (num_subtasks,):
            raise ValueError(f"{name}: shape {end.shape}, expected {(num_subtasks,)}")
        ends.append(end)
    valid = None if num_valid is None else jnp.arange(num_timesteps) < num_valid
    return Weights(ll, tuple(bands), ends[0], ends[1], valid)


def _raise_if_impossible(total: Array, chain: Weights) -> None:
    if isinstance(total, Tracer) or np.isfinite(total):
        return
    n = chain.log_likelihoods.shape[0] if chain.valid is None else int(chain.valid.sum())
    bands = [np.asarray(band if band.ndim == 1 else band[: n - 1], float) for band in chain.bands]
    ll, ends = np.asarray(chain.log_likelihoods[:n], float), (chain.log_initial, chain.log_final)
    if np.isnan(ll).any():
        where = np.argwhere(np.isnan(ll))[0].tolist()
        raise ValueError(f"log_likelihoods: NaN or +inf at {where}, expected numbers or -inf")
    raise why_infeasible(ll, Chain(bands[0], bands[1], bands[2:] or None, log_initial=np.asarray(ends[0]),
                                   log_final=np.asarray(ends[1])))  # fmt: skip


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
    best = best_path(chain)
    _raise_if_impossible(best.log_prob, chain)
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
    found = filtered(chain)
    _raise_if_impossible(found.log_evidence, chain)
    return found


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
    posterior = smoothed(chain)
    _raise_if_impossible(posterior.log_evidence, chain)
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
    paths, log_evidence = draw(key, chain, num_samples)
    _raise_if_impossible(log_evidence, chain)
    return paths
