"""The posterior mode of the scales, and the Laplace approximation around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from estimation.density import NUM_CHANNELS, Tables, log_density, padded
from estimation.posterior import Posterior
from hmmseg.jaxconfig import double_precision

TOLERANCE, MAX_STEPS = 1e-6, 256  # numerics: relative and absolute, of scales and density
PADDING = 8  # numerics: of deviations, rounded up to a multiple of it so that few programs are compiled
STEP = 1e-3  # numerics: of the scales, all logarithms, for derivatives by central differences
STARTS = np.arange(-1.0, 9.0, 1.0)  # numerics: log(share / prior median); a large share is a mode of its own


@dataclass(frozen=True)
class Mode:
    """Mode (6,) of the scales and their covariance (6, 6); unknowns (Q,) there and theirs (Q, Q).

    The covariance of the unknowns holds at the scales' mode.
    """

    scales: np.ndarray
    covariance: np.ndarray
    unknowns: np.ndarray
    unknowns_covariance: np.ndarray
    converged: bool


@double_precision
def find_mode(post: Posterior) -> Mode:
    """Mode by optimistix's BFGS from the best of a few shares a channel; curvature by central differences."""
    steps = STEP * np.eye(2 * NUM_CHANNELS)

    def gradient(x: np.ndarray) -> np.ndarray:
        up, down = np.split(post.log_prob(np.concatenate([x + steps, x - steps])), 2)
        return -(up - down) / (2 * STEP)

    found = np.array(_climb()(start_of(post), padded(post.tables, PADDING)))
    hessian = np.array([(gradient(found + h) - gradient(found - h)) / (2 * STEP) for h in steps])
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    covariance = (vectors / np.maximum(values, 0.1)) @ vectors.T
    mean, chol = post.given(found[None])
    num = len(post.design.unknowns)
    factor = np.linalg.inv(chol[0])[:, :num]
    slope = float(np.abs(gradient(found)).max())
    return Mode(found, covariance, post.reference + mean[0, :num], factor.T @ factor, slope < 1e-2)


@lru_cache
def _climb() -> Callable[[np.ndarray, Tables], Any]:
    """From a start (6,) to the density's next maximum (6,); one compiled program for each padded size.

    On the processor, whatever accelerator there is: six scales are not worth the way there.
    """
    import jax  # these are slow to import
    import jax.numpy as jnp
    import optimistix

    solver = optimistix.BFGS(rtol=TOLERANCE, atol=TOLERANCE)

    def loss(theta: Any, tables: Tables) -> Any:
        return -log_density(theta[None], tables, jnp)[0]

    def climb(start: Any, tables: Tables) -> Any:
        return optimistix.minimise(loss, solver, start, tables, max_steps=MAX_STEPS, throw=False).value

    # It runs for milliseconds: what optimising the program takes is more than what that could save.
    quickly_compiled = {"xla_backend_optimization_level": 0}
    program, processor = jax.jit(climb, compiler_options=quickly_compiled), jax.devices("cpu")[0]

    def on_processor(start: np.ndarray, tables: Tables) -> Any:
        with jax.default_device(processor):
            return program(start, tables)

    return on_processor


def start_of(post: Posterior) -> np.ndarray:
    """Scales (6,) from which to climb: each channel's share the best of STARTS, one after the other."""
    best = np.zeros(2 * NUM_CHANNELS)
    for c in range(NUM_CHANNELS):
        starts = np.repeat(best[None], STARTS.size, axis=0)
        starts[:, NUM_CHANNELS + c] = STARTS
        best = starts[int(np.argmax(post.log_prob(starts)))]
    return best
