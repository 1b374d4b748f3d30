"""The posterior mode by BFGS (optimistix), and the Laplace approximation around it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from estimation.design import Design
from estimation.posterior import Data, log_likelihoods, mean_log_prob

MAX_STEPS = 512


@dataclass(frozen=True)
class Mode:
    """Mode (dim,), Laplace covariance (dim, dim), and the data with alignments referred to it."""

    x: np.ndarray
    covariance: np.ndarray
    data: Data
    converged: bool


def start(design: Design) -> np.ndarray:
    """Start of the search for the mode: the paper's Table 3 on the spans' means, nothing else known."""
    rows = design.coefficients[design.there]
    scale = np.sqrt(design.variance[design.there])
    found, *_ = np.linalg.lstsq(rows / scale[:, None], design.mean[design.there] / scale, rcond=None)
    floor = 1e-3 * np.abs(found).max() + 1e-6
    return np.concatenate([np.log(np.maximum(found, floor)), np.zeros(9 + len(design.nuisances))])


@jax.jit
def _find(start: jax.Array, data: Data) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Newton-whitened BFGS: curvatures of log properties exceed the priors' 1e8-fold."""
    hessian = jax.hessian(lambda x: -mean_log_prob(x, data))
    values, vectors = jnp.linalg.eigh(hessian(start))
    whiten = vectors / jnp.sqrt(jnp.maximum(jnp.abs(values), 1e-3))[None, :]

    def loss(y: jax.Array, _: None) -> jax.Array:
        return -mean_log_prob(start + whiten @ y, data)

    solver = optx.BFGS(rtol=1e-8, atol=1e-8)
    found = optx.minimise(loss, solver, jnp.zeros_like(start), max_steps=MAX_STEPS, throw=False)
    x = start + whiten @ found.value
    done = found.result == optx.RESULTS.successful
    return x, hessian(x), log_likelihoods(x, data), done


def find_mode(start: np.ndarray, data: Data) -> Mode:
    """Mode from `start` (dim,), its Laplace covariance, and alignments referred to it.

    `converged` is False where BFGS ran out of steps; the sampler then starts from the best point.
    """
    x, hessian, reference, done = _find(jnp.asarray(start), data)
    values, vectors = np.linalg.eigh(np.asarray(hessian))
    covariance = (vectors / np.maximum(values, 1e-6)) @ vectors.T
    return Mode(np.asarray(x), covariance, data._replace(reference=reference), bool(done))
