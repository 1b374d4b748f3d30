"""Sampling of the scales by emcee, and of the unknowns given them: moves, convergence, draws.

All else is integrated out (`estimation.posterior`), so emcee moves in six dimensions whatever the task. Most
proposals are independent draws (`Proposal`), the others differential evolution (ter Braak 2006), which frees
walkers that would be stuck in a tail. benchmarks/moves.py of commit f82105c compares them with emcee's
stretch move.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from estimation import priors
from estimation.posterior import NUM_CHANNELS, Mode, Posterior, find_mode
from hmmseg.tables import Brief

TAIL = 5.0  # numerics: degrees of freedom of noise proposals, whose tails must exceed the posterior's
WIDEN = 1.1  # numerics: factor of the Laplace covariance, for the same reason
# numerics: share of scatter proposals from a t about the prior median, whose tails exceed any posterior's
FROM_PRIOR = 0.1
STEP, REACH = 0.25, (-10.0, 10.0)  # numerics: of the grid, in log(share / its prior median)


@dataclass(frozen=True)
class Proposal:
    """Multivariate t of the noise scales, and grid densities of the scatters."""

    mean: np.ndarray  # (3,)
    chol: np.ndarray  # (3, 3)
    cells: np.ndarray  # (3, G) probabilities of the grid's intervals, of width STEP from REACH[0] on

    def draw(self, num: int, random: np.random.RandomState) -> np.ndarray:
        """Proposals (num, 6)."""
        chi2 = random.chisquare(TAIL, size=(num, 1)) / TAIL
        noise = self.mean + random.normal(size=(num, NUM_CHANNELS)) / np.sqrt(chi2) @ self.chol.T
        cumulative = np.cumsum(self.cells, axis=1)
        chosen = [np.searchsorted(row / row[-1], random.uniform(size=num)) for row in cumulative]
        scatter = REACH[0] + STEP * (np.stack(chosen, axis=1) + random.uniform(size=(num, NUM_CHANNELS)))
        prior = priors.SCATTER_LOG_SD * random.standard_t(TAIL, size=scatter.shape)
        from_prior = random.uniform(size=scatter.shape) < FROM_PRIOR
        return np.concatenate([noise, np.where(from_prior, prior, scatter)], axis=1)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density (num,) of proposing x (num, 6)."""
        z = np.linalg.solve(self.chol, (x[:, :NUM_CHANNELS] - self.mean).T)
        out = _log_student((z**2).sum(axis=0), NUM_CHANNELS) - np.log(np.diag(self.chol)).sum()
        scatter = x[:, NUM_CHANNELS:]
        cell = np.floor((scatter - REACH[0]) / STEP).astype(int)
        inside = (cell >= 0) & (cell < self.cells.shape[1])
        drawn = self.cells[np.arange(NUM_CHANNELS), np.where(inside, cell, 0)] / STEP
        z2 = (scatter / priors.SCATTER_LOG_SD) ** 2
        prior = np.exp(_log_student(z2, 1)) / priors.SCATTER_LOG_SD
        return out + np.log((1 - FROM_PRIOR) * np.where(inside, drawn, 0.0) + FROM_PRIOR * prior).sum(axis=1)


def proposal(post: Posterior, mode: Mode) -> Proposal:
    """The proposal about a mode."""
    middle = np.arange(REACH[0] + STEP / 2, REACH[1], STEP)
    cells = []
    for c in range(NUM_CHANNELS):
        along = np.repeat(mode.scales[None], middle.size, axis=0)
        along[:, NUM_CHANNELS + c] = middle
        log_prob = post.log_prob(along)
        cells.append(np.exp(log_prob - log_prob.max()))
    noise = WIDEN * mode.covariance[:NUM_CHANNELS, :NUM_CHANNELS]
    found = np.stack([row / row.sum() for row in cells])
    return Proposal(mode.scales[:NUM_CHANNELS], np.linalg.cholesky(noise), found)


def _log_student(z2: np.ndarray, dim: int) -> np.ndarray:
    """Log density of a t of unit scale, TAIL and `dim` dimensions, from squared distances."""
    constant = gammaln((TAIL + dim) / 2) - gammaln(TAIL / 2) - dim / 2 * np.log(TAIL * np.pi)
    return constant - (TAIL + dim) / 2 * np.log1p(z2 / TAIL)


INDEPENDENT = 0.9  # numerics: share of independence proposals
WALKERS = 64  # numerics: of emcee
BURN_IN, CHUNK, MAX_STEPS = 25, 100, 2000  # numerics: steps discarded, between convergence checks, at most
MIN_LENGTH = 50  # cited: steps in units of the autocorrelation time, emcee's own rule
MIN_ESS, MAX_RHAT = 1000.0, 1.01  # cited: Gelman et al. 2013, and enough for two digits of a quantile
ENOUGH = 1.5 * MIN_ESS  # sample size at which to stop, as its estimate is itself uncertain
GROUPS = 4  # numerics: chains into which walkers are joined for R-hat
KEPT = 4096  # numerics: least draws of the unknowns, if the chain has as many
BATCH = 256  # numerics: draws at once
MIN_EFFICIENCY = 0.05  # numerics: least effective share of draws after weighting by the unknowns' priors


@dataclass(frozen=True, repr=False)
class Draws(Brief):
    """Posterior draws of the scales and unknowns."""

    scales: np.ndarray  # (walkers, steps, 6)
    chain: np.ndarray  # (walkers, steps, Q) of the unknowns [N, m]
    deviations: np.ndarray  # (walkers, steps, N) of the hand
    shares: np.ndarray  # (walkers, steps, 6) model error common to all grips
    ess: float  # smallest over scales, by emcee's autocorrelation time
    rhat: float  # largest split R-hat over scales, with walkers as chains (Gelman et al. 2013)
    acceptance: float
    steps: int
    prior_ess: float  # effective share of draws after weighting by the unknowns' priors
    impossible: tuple[int, ...] = ()  # unknowns all of whose draws have an impossible sign

    @property
    def flat(self) -> np.ndarray:
        """Draws (num_draws, Q) of the unknowns."""
        return self.chain.reshape(-1, self.chain.shape[-1])

    @property
    def shortfall(self) -> str:
        """The first convergence criterion that fails, with its number; empty if none does."""
        if self.ess < MIN_ESS:
            return f"effective sample size of {self.ess:.0f}; {MIN_ESS:.0f} are needed"
        if self.rhat > MAX_RHAT:
            return f"R-hat of {self.rhat:.3f}; at most {MAX_RHAT:g} is allowed"
        if self.prior_ess < MIN_EFFICIENCY:
            shared = f"recording and priors have {self.prior_ess:.2%} of the draws in common"
            return f"{shared}; at least {MIN_EFFICIENCY:.0%} are needed"
        return ""

    @property
    def converged(self) -> bool:
        """Whether all criteria are met, priors included."""
        return not self.shortfall


def sample(
    post: Posterior, seed: int, progress: Callable[[int, int], None] | None = None, mode: Mode | None = None
) -> Draws:
    """Draw from the posterior until converged or MAX_STEPS; `progress(steps, of)` is called meanwhile."""
    import emcee  # slow to import: it loads scipy.stats

    mode = find_mode(post) if mode is None else mode
    random = np.random.RandomState(seed)
    independent = proposal(post, mode)
    start = independent.draw(WALKERS, random)

    def anew(x: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        new = independent.draw(len(x), random)
        return new, independent.log_density(x) - independent.log_density(new)

    moves = [(emcee.moves.MHMove(anew), INDEPENDENT), (emcee.moves.DEMove(), 1 - INDEPENDENT)]
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
    acceptance = float(sampler.acceptance_fraction.mean())
    thin = max(chain.shape[0] * chain.shape[1] // KEPT, 1)
    scales = chain[:, thin - 1 :: thin]
    rest, prior_ess, impossible = draw_unknowns(post, scales.reshape(-1, scales.shape[-1]), random)
    num, deviations = len(post.design.unknowns), len(post.design.nuisances)
    rest = rest.reshape(*scales.shape[:2], -1)
    return Draws(
        scales, rest[..., :num], rest[..., num : num + deviations], rest[..., num + deviations :],
        ess, rhat, acceptance, steps, prior_ess, impossible,
    )  # fmt: skip


def draw_unknowns(
    post: Posterior, theta: np.ndarray, random: np.random.RandomState
) -> tuple[np.ndarray, float, tuple[int, ...]]:
    """Draws (W, Q + N + 6) of unknowns, deviations and common shares, one per row of scales.

    Drawn from the conditional Gaussian, with a flat prior of the unknowns, and resampled by the unknowns' own
    prior (systematically, so order is kept). Also returns the effective share of draws after that (close to 1
    if the recording decides), and the unknowns all of whose draws the prior excludes, which keep their draws.
    """
    parts = []
    for k in range(0, len(theta), BATCH):
        mean, chol = post.given(theta[k : k + BATCH])
        z = random.normal(size=mean.shape)
        parts.append(mean + np.linalg.solve(np.swapaxes(chol, 1, 2), z[..., None])[..., 0])
    out = np.concatenate(parts)
    out[:, : post.reference.size] += post.reference
    log_weight, impossible = np.zeros(len(out)), []
    for i, u in enumerate(post.design.unknowns):
        of_prior = priors.log_prior(u.prop, np.array(list(u.terms.values())), out[:, i])
        if np.isfinite(of_prior).any():
            log_weight += of_prior
        else:
            impossible.append(i)
    if not np.isfinite(log_weight).any():
        return out, 0.0, tuple(impossible)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return out[_resampled(weight, random)], float(1 / (weight**2).sum() / len(weight)), tuple(impossible)


def _resampled(weight: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Indices (num,) of a systematic resample."""
    points = (random.uniform() + np.arange(weight.size)) / weight.size
    return np.minimum(np.searchsorted(np.cumsum(weight), points), weight.size - 1)


def effective_sample_size(chain: np.ndarray) -> float:
    """Smallest effective sample size over parameters of a chain (walkers, steps, dim), by emcee's
    autocorrelation time (Goodman & Weare 2010); 0 if a parameter never moved."""
    import emcee  # slow to import: it loads scipy.stats

    with np.errstate(invalid="ignore"):  # 0 / 0 of a walker that never moved
        tau = emcee.autocorr.integrated_time(np.swapaxes(chain, 0, 1), quiet=True, tol=0)
    size = chain.shape[0] * chain.shape[1] / np.max(tau)
    return float(size) if np.isfinite(size) else 0.0


def split_rhat(chain: np.ndarray) -> float:
    """Largest split R-hat over parameters of a chain (walkers, steps, dim) whose walkers are joined into
    GROUPS chains, halved in time: Gelman et al. 2013, section 11.4. Walkers of an ensemble are not
    independent, so this only detects drift and stuck groups."""
    walkers, steps, dim = chain.shape
    half, per_group = steps // 2, walkers // GROUPS
    kept = chain[: GROUPS * per_group, : 2 * half].reshape(GROUPS, per_group, 2, half, dim)
    parts = np.swapaxes(kept, 1, 2).reshape(2 * GROUPS, per_group * half, dim)
    within = parts.var(axis=1, ddof=1).mean(axis=0)
    between = parts.mean(axis=1).var(axis=0, ddof=1)
    return float(np.sqrt(np.max(1 + between / within)))
