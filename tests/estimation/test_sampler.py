"""The sampler on a posterior with a known answer, its proposal, and its measures of convergence."""

import emcee
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import make_design, start_of

from estimation.mode import find_mode
from estimation.posterior import log_prob_batch, pack
from estimation.proposal import proposal
from estimation.sampler import GROUPS, MIN_ESS, Draws, effective_sample_size, sample, split_rhat


@pytest.fixture(scope="module")
def mode():
    design = make_design(spread=0.2)
    return find_mode(start_of(design), pack(design))


@pytest.fixture(scope="module")
def draws(mode):
    return sample(mode, seed=1)


def ar1(shape, rho, rng):
    """Chains (walkers, steps, 1) of unit variance with autocorrelation rho^lag."""
    out = np.empty(shape)
    out[:, 0] = rng.normal(size=shape[0])
    for k in range(1, shape[1]):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=shape[0])
    return out[..., None]


def importance(mode, num=40_000):
    """Draws of the proposal with self-normalised importance weights: another route to moments."""
    found = proposal(mode)
    x, log_density = found.draw(num, np.random.RandomState(5))
    log_weight = np.concatenate([
        np.asarray(log_prob_batch(jnp.asarray(part), mode.data)) for part in np.split(x, 10)
    ]) - log_density  # fmt: skip
    weight = np.exp(log_weight - log_weight.max())
    return x, weight / weight.sum()


def test_draws_have_the_moments_of_importance_sampling(mode, draws):
    x, weight = importance(mode)
    assert 1 / (weight**2).sum() > 0.4 * len(x)  # the proposal is close, so its weights are even
    mean = weight @ x
    sd = np.sqrt(weight @ (x - mean) ** 2)
    assert draws.converged and draws.ess >= MIN_ESS
    np.testing.assert_allclose(draws.flat.mean(axis=0), mean, atol=5 * sd.max() / np.sqrt(draws.ess))
    z = (draws.flat.mean(axis=0) - mean) / sd * np.sqrt(draws.ess)
    assert np.abs(z).max() < 5
    np.testing.assert_allclose(draws.flat.std(axis=0), sd, rtol=0.06)
    correlation = np.corrcoef(draws.flat.T)
    centred = (x - mean) / sd
    np.testing.assert_allclose(correlation, (centred.T * weight) @ centred, atol=0.06)


def test_a_gaussian_posterior_is_sampled_as_the_closed_form_has_it():
    """Scales and scatter all but held: Gaussian with the Laplace covariance."""
    design = make_design(spread=0.0)
    data = pack(design)._replace(scale_sd=jnp.full(3, 1e-3), tau=jnp.full(3, 1e-9))
    mode = find_mode(start_of(design), data)
    found = sample(mode, seed=2)
    sd = np.sqrt(np.diag(mode.covariance))
    z = (found.flat.mean(axis=0) - mode.x) / sd
    assert np.abs(z).max() < 5 / np.sqrt(found.ess)
    np.testing.assert_allclose(found.flat.std(axis=0), sd, rtol=0.05)


def test_the_same_seed_draws_the_same(mode, draws):
    again, other = sample(mode, seed=1), sample(mode, seed=2)
    np.testing.assert_array_equal(again.chain, draws.chain)
    assert not np.array_equal(other.chain[:, :10], draws.chain[:, :10])


def test_progress_is_told(mode):
    told = []
    sample(mode, 0, lambda steps, of: told.append((steps, of)))
    assert [s for s, _ in told] == sorted(s for s, _ in told) and told[0][0] > 0


def test_density_of_the_proposal_is_that_of_its_draws(mode):
    """Stated densities agree, and integrate to one: the mean of q / p over p's draws, p a Gaussian."""
    found = proposal(mode)
    x, log_density = found.draw(500, np.random.RandomState(0))
    np.testing.assert_allclose(found.log_density(x), log_density, rtol=1e-9)
    # A Gaussian narrower than the proposal has a bounded ratio to it, whose mean is 1.
    draws, log_density = found.draw(20_000, np.random.RandomState(1))
    chol = np.linalg.cholesky(0.3 * mode.covariance)
    z = np.linalg.solve(chol, (draws - mode.x).T)
    log_normal = -0.5 * (z**2).sum(axis=0) - 0.5 * len(z) * np.log(2 * np.pi)
    ratio = np.exp(log_normal - np.log(np.diag(chol)).sum() - log_density)
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(ratio.size))
    assert ratio.std() < 30


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_effective_sample_size_of_a_chain_with_known_autocorrelation(rho):
    chain = ar1((40, 3000), rho, np.random.default_rng(0))
    expected = chain.size * (1 - rho) / (1 + rho)
    assert effective_sample_size(chain) == pytest.approx(
        expected, rel=0.15
    )  # the window of 5 tau loses 1 % or more


def test_the_worst_parameter_counts():
    rng = np.random.default_rng(1)
    good, bad = ar1((20, 2000), 0.0, rng), ar1((20, 2000), 0.8, rng)
    both = effective_sample_size(np.concatenate([good, bad], axis=2))
    assert both == pytest.approx(effective_sample_size(bad))


def test_a_frozen_chain_has_no_effective_samples():
    assert effective_sample_size(np.ones((8, 100, 2))) == 0.0
    assert not Draws(np.ones((8, 100, 2)), 0.0, 1.0, 0.0).converged


def test_rhat_of_independent_draws_is_one():
    chain = np.random.default_rng(2).normal(size=(32, 500, 3))
    assert split_rhat(chain) == pytest.approx(1.0, abs=2e-3)


def test_rhat_against_its_definition_and_drift():
    """Groups whose means differ by d standard deviations: 1 + var(means) / 1."""
    rng = np.random.default_rng(3)
    chain = rng.normal(size=(4 * GROUPS, 2000, 1))
    shift = np.repeat(np.arange(GROUPS) * 0.5, 4)[:, None, None]
    means = np.repeat(np.arange(GROUPS) * 0.5, 2)  # both halves
    assert split_rhat(chain + shift) == pytest.approx(np.sqrt(1 + means.var(ddof=1)), rel=0.02)
    drift = np.linspace(-1, 1, 2000)[None, :, None]
    assert split_rhat(chain + drift) > 1.1


def test_ess_agrees_with_emcees_own_autocorrelation_time():
    chain = ar1((16, 1500), 0.6, np.random.default_rng(4))
    tau = emcee.autocorr.integrated_time(chain.swapaxes(0, 1), quiet=True, tol=0)[0]
    assert effective_sample_size(chain) == pytest.approx(chain.size / tau)
