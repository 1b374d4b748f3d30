"""emcee on the posterior: moves, convergence and draws.

Given the noise scales and the trial-to-trial scatter the posterior is nearly Gaussian, and its
width follows them. So most proposals are independent draws that know this (estimation.proposal;
accepted often, so autocorrelation is a few steps), the rest are differential evolution moves (ter
Braak 2006), which need no such approximation and free walkers that it would hold in a tail.
experiments/benchmarks/moves.py compares them with emcee's stretch move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import emcee
import jax.numpy as jnp
import numpy as np

from estimation.mode import Mode
from estimation.posterior import log_prob_batch
from estimation.proposal import proposal

INDEPENDENT = 0.9  # share of independence proposals
WALKERS = 64
BURN_IN, CHUNK, MAX_STEPS = 50, 100, 2000
MIN_LENGTH = 50  # steps in units of the autocorrelation time, emcee's own rule
MIN_ESS, MAX_RHAT = 1000.0, 1.01
GROUPS = 4  # chains that walkers are joined into for R-hat


@dataclass(frozen=True)
class Draws:
    """Posterior draws (num_walkers, num_steps, dim) and how they converged.

    `ess`: smallest effective sample size over parameters (emcee's autocorrelation time), `rhat`:
    largest split R-hat over parameters, walkers as chains (Gelman et al. 2013).
    """

    chain: np.ndarray
    ess: float
    rhat: float
    acceptance: float

    @property
    def flat(self) -> np.ndarray:
        """Draws (num_draws, dim)."""
        return self.chain.reshape(-1, self.chain.shape[-1])

    @property
    def converged(self) -> bool:
        """Whether ESS and R-hat reach what this module asks for."""
        return self.ess >= MIN_ESS and self.rhat <= MAX_RHAT


def independence_move(mode: Mode) -> emcee.moves.MHMove:
    """Move of every walker to an independent draw of the proposal about the mode."""
    independent = proposal(mode)

    def propose(x: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        new, log_density = independent.draw(len(x), random)
        return new, independent.log_density(x) - log_density

    return emcee.moves.MHMove(propose)


def sample(mode: Mode, seed: int, progress: Callable[[int, int], None] | None = None) -> Draws:
    """Draws from the posterior, until converged or MAX_STEPS; `progress(steps, of)` is called."""
    dim = mode.x.size
    walkers = max(WALKERS, 4 * ((dim + 1) // 2))
    random = np.random.RandomState(seed)
    start, _ = proposal(mode).draw(walkers, random)

    def log_prob(x: np.ndarray) -> np.ndarray:
        return np.asarray(log_prob_batch(jnp.asarray(x), mode.data))

    moves = [(independence_move(mode), INDEPENDENT), (emcee.moves.DEMove(), 1 - INDEPENDENT)]
    sampler = emcee.EnsembleSampler(walkers, dim, log_prob, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=random.get_state())
    state = sampler.run_mcmc(state, BURN_IN)
    sampler.reset()
    steps = 0
    while steps < MAX_STEPS:
        state = sampler.run_mcmc(state, CHUNK)
        steps += CHUNK
        chain = np.swapaxes(np.asarray(sampler.get_chain()), 0, 1)
        ess, rhat = effective_sample_size(chain), split_rhat(chain)
        if progress is not None:
            progress(steps, MAX_STEPS)
        long = ess >= MIN_LENGTH * walkers
        if steps >= 2 * CHUNK and long and ess >= 1.5 * MIN_ESS and rhat <= MAX_RHAT:
            break
    return Draws(chain, ess, rhat, float(sampler.acceptance_fraction.mean()))


def effective_sample_size(chain: np.ndarray) -> float:
    """Smallest effective sample size over parameters of a chain (walkers, steps, dim).

    By emcee's autocorrelation time (Goodman & Weare 2010); 0 where a parameter never moved.
    """
    with np.errstate(invalid="ignore"):  # 0 / 0 of a walker that never moved
        tau = emcee.autocorr.integrated_time(np.swapaxes(chain, 0, 1), quiet=True, tol=0)
    size = chain.shape[0] * chain.shape[1] / np.max(tau)
    return float(size) if np.isfinite(size) else 0.0


def split_rhat(chain: np.ndarray) -> float:
    """Largest split R-hat over parameters of a chain (walkers, steps, dim).

    Walkers are joined into GROUPS chains (a walker alone is too short to have a variance of its
    own), each halved in time: Gelman et al. 2013, Bayesian Data Analysis, section 11.4. Walkers of
    an ensemble are not independent, so this checks for drift and stuck groups, no more.
    """
    walkers, steps, dim = chain.shape
    half, per_group = steps // 2, walkers // GROUPS
    kept = chain[: GROUPS * per_group, : 2 * half].reshape(GROUPS, per_group, 2, half, dim)
    parts = np.swapaxes(kept, 1, 2).reshape(2 * GROUPS, per_group * half, dim)
    within = parts.var(axis=1, ddof=1).mean(axis=0)
    between = parts.mean(axis=1).var(axis=0, ddof=1)
    return float(np.sqrt(np.max(1 + between / within)))
