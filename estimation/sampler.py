"""emcee on the scales, the unknowns drawn given them: moves, convergence and draws.

All else is integrated out (`estimation.posterior`), so emcee moves in six dimensions whatever the
task. Most proposals are independent draws (`estimation.proposal`), the rest differential evolution
(ter Braak 2006), which frees walkers that it would hold in a tail. The chain is checked against the
same proposal's importance-weighted draws, which owe nothing to the chain.
experiments/benchmarks/moves.py compares them with emcee's stretch move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimation import priors
from estimation.mode import Mode, find_mode
from estimation.posterior import Posterior
from estimation.proposal import Proposal, proposal
from hmmseg.tables import Brief

if TYPE_CHECKING:
    import emcee

INDEPENDENT = 0.9  # numerics: share of independence proposals
WALKERS = 64  # numerics: of emcee
BURN_IN, CHUNK, MAX_STEPS = 25, 100, 2000  # numerics: steps left out, between looks at convergence, at most
MIN_LENGTH = 50  # cited: steps in units of the autocorrelation time, emcee's own rule
MIN_ESS, MAX_RHAT = 1000.0, 1.01  # cited: Gelman et al. 2013, and enough for two digits of a quantile
ENOUGH = 1.5 * MIN_ESS  # to stop at: an estimate of it is itself uncertain
GROUPS = 4  # numerics: chains that walkers are joined into for R-hat
KEPT = 4096  # numerics: draws of the unknowns at least, where the chain has so many
BATCH = 256  # numerics: drawn at once
IMPORTANCE = 4000  # numerics: independent draws that the chain is checked against
MIN_EFFICIENCY = 0.05  # numerics: of them, for a check, and to stand in where the chain does not converge
MAX_APART = 0.25  # numerics: of a posterior sd, between the chain's means of the scales and those draws'


@dataclass(frozen=True, repr=False)
class Draws(Brief):
    """Posterior draws of the scales (walkers, steps, 6) and unknowns (walkers, steps, Q) [N, m].

    `ess`: smallest effective sample size over scales (emcee's autocorrelation time), `rhat`: largest
    split R-hat over scales, walkers as chains (Gelman et al. 2013). `shares` (walkers, steps, 6):
    of model error that all grips have alike; `deviations` (walkers, steps, N) of the hand.
    `apart`: largest distance of the chain's mean scales from those of importance-weighted draws, in
    posterior sds; None where these are too few. `method`: "emcee", or "laplace" for those draws, which
    stand in where the chain did not converge. `prior_ess`: share of draws left effective by the
    unknowns' priors.
    """

    scales: np.ndarray
    chain: np.ndarray
    deviations: np.ndarray
    shares: np.ndarray
    ess: float
    rhat: float
    acceptance: float
    steps: int
    method: str
    prior_ess: float
    apart: float | None

    @property
    def flat(self) -> np.ndarray:
        """Draws (num_draws, Q) of the unknowns."""
        return self.chain.reshape(-1, self.chain.shape[-1])

    @property
    def converged(self) -> bool:
        """Whether ESS and R-hat reach what this module asks for, priors taken in."""
        agreed = self.apart is None or self.apart <= MAX_APART
        return agreed and self.ess >= MIN_ESS and self.rhat <= MAX_RHAT and self.prior_ess >= MIN_EFFICIENCY


def independence_move(independent: Proposal) -> emcee.moves.MHMove:
    """Move of every walker to an independent draw of the proposal."""
    import emcee  # slow to import: it loads scipy.stats

    def propose(x: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        new = independent.draw(len(x), random)
        return new, independent.log_density(x) - independent.log_density(new)

    return emcee.moves.MHMove(propose)


def sample(
    post: Posterior, seed: int, progress: Callable[[int, int], None] | None = None, mode: Mode | None = None
) -> Draws:
    """Draws from the posterior, until converged or MAX_STEPS; `progress(steps, of)` is called."""
    import emcee  # slow to import: it loads scipy.stats

    mode = find_mode(post) if mode is None else mode
    random = np.random.RandomState(seed)
    independent = proposal(post, mode)
    start = independent.draw(WALKERS, random)
    moves = [(independence_move(independent), INDEPENDENT), (emcee.moves.DEMove(), 1 - INDEPENDENT)]
    sampler = emcee.EnsembleSampler(WALKERS, start.shape[1], post.log_prob, moves=moves, vectorize=True)
    state = sampler.run_mcmc(emcee.State(start, random_state=random.get_state()), BURN_IN)
    sampler.reset()
    steps, ess, rhat = 0, 0.0, np.inf
    chain = np.zeros((WALKERS, 0, start.shape[1]))
    while steps < MAX_STEPS:
        state = sampler.run_mcmc(state, CHUNK)
        steps += CHUNK
        chain = np.swapaxes(np.asarray(sampler.get_chain()), 0, 1)
        ess, rhat = effective_sample_size(chain), split_rhat(chain)
        if progress is not None:
            progress(steps, MAX_STEPS)
        long = ess >= MIN_LENGTH * WALKERS
        if steps >= 2 * CHUNK and long and ess >= ENOUGH and rhat <= MAX_RHAT:
            break
    acceptance, method = float(sampler.acceptance_fraction.mean()), "emcee"
    drawn, weight = importance(post, independent, random)
    efficiency, apart = 1 / (weight**2).sum() / len(weight), None
    if efficiency >= MIN_EFFICIENCY:
        apart = _apart(chain, drawn, weight)
        if ess < MIN_ESS or rhat > MAX_RHAT or apart > MAX_APART:
            drawn, weight = importance(post, independent, random, int(ENOUGH / efficiency))
            index = random.permutation(_resampled(weight, random))
            num = len(index) // WALKERS
            chain = drawn[index[: WALKERS * num]].reshape(WALKERS, num, -1)
            ess, rhat, method, apart = float(1 / (weight**2).sum()), 1.0, "laplace", None
    thin = max(chain.shape[0] * chain.shape[1] // KEPT, 1)
    scales = chain[:, thin - 1 :: thin]
    rest, prior_ess = draw_unknowns(post, scales.reshape(-1, scales.shape[-1]), random)
    num, deviations = len(post.design.unknowns), len(post.design.nuisances)
    rest = rest.reshape(*scales.shape[:2], -1)
    return Draws(
        scales, rest[..., :num], rest[..., num : num + deviations], rest[..., num + deviations :],
        ess, rhat, acceptance, steps, method, prior_ess, apart,
    )  # fmt: skip


def importance(
    post: Posterior, independent: Proposal, random: np.random.RandomState, num: int = IMPORTANCE
) -> tuple[np.ndarray, np.ndarray]:
    """Draws (num, 6) of the proposal and their normalised importance weights (num,)."""
    x = independent.draw(num, random)
    log_weight = post.log_prob(x) - independent.log_density(x)
    weight = np.exp(log_weight - log_weight.max())
    return x, weight / weight.sum()


def _apart(chain: np.ndarray, drawn: np.ndarray, weight: np.ndarray) -> float:
    """Largest distance of the means of a chain (walkers, steps, 6) from weighted draws', in their sds."""
    mean = weight @ drawn
    sd = np.sqrt(weight @ (drawn - mean) ** 2)
    return float(np.max(np.abs(chain.mean(axis=(0, 1)) - mean) / sd))


def draw_unknowns(
    post: Posterior, theta: np.ndarray, random: np.random.RandomState
) -> tuple[np.ndarray, float]:
    """Draws (W, Q + N + 6) of unknowns, deviations and common shares, one for each row of scales.

    They come from the conditional Gaussian, whose prior of the unknowns is flat, and are resampled
    by the unknowns' own prior (systematically, so order is kept). Also the share of draws that this
    leaves effective: next to 1 where the recording decides.
    """
    parts = []
    for k in range(0, len(theta), BATCH):
        mean, chol = post.given(theta[k : k + BATCH])
        z = random.normal(size=mean.shape)
        parts.append(mean + np.linalg.solve(np.swapaxes(chol, 1, 2), z[..., None])[..., 0])
    out = np.concatenate(parts)
    out[:, : post.reference.size] += post.reference
    log_weight = np.zeros(len(out))
    for i, u in enumerate(post.design.unknowns):
        log_weight += priors.log_prior(u.prop, np.array(list(u.terms.values())), out[:, i])
    if not np.isfinite(log_weight).any():
        return out, 0.0
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return out[_resampled(weight, random)], float(1 / (weight**2).sum() / len(weight))


def _resampled(weight: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Indices (num,) of a systematic resample."""
    points = (random.uniform() + np.arange(weight.size)) / weight.size
    return np.minimum(np.searchsorted(np.cumsum(weight), points), weight.size - 1)


def effective_sample_size(chain: np.ndarray) -> float:
    """Smallest effective sample size over parameters of a chain (walkers, steps, dim).

    By emcee's autocorrelation time (Goodman & Weare 2010); 0 where a parameter never moved.
    """
    import emcee  # slow to import: it loads scipy.stats

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
