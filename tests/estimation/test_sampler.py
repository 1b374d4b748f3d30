"""The sampler on a posterior with a known answer, its proposal, and its measures of convergence."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_scene import UNIT, drawn, make_design

from estimation import priors, sampler
from estimation.posterior import find_mode, posterior
from estimation.sampler import GROUPS, MIN_ESS, effective_sample_size, proposal, sample, split_rhat


def importance(post, mode, seed, num):
    """Draws (num, 6) of the proposal and their normalised importance weights (num,)."""
    independent = proposal(post, mode)
    x = independent.draw(num, np.random.RandomState(seed))
    log_weight = post.log_prob(x) - independent.log_density(x)
    weight = np.exp(log_weight - log_weight.max())
    return x, weight / weight.sum()


@pytest.fixture(scope="module")
def post():
    return posterior(drawn(make_design(deviations=2), 1)[0])


@pytest.fixture(scope="module")
def mode(post):
    return find_mode(post)


@pytest.fixture(scope="module")
def draws(post):
    return sample(post, seed=1)


def ar1(shape, rho, rng):
    """Chains (walkers, steps, 1) of unit variance with autocorrelation rho^lag."""
    out = np.empty(shape)
    out[:, 0] = rng.normal(size=shape[0])
    for k in range(1, shape[1]):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=shape[0])
    return out[..., None]


def test_scales_have_the_moments_of_importance_sampling(post, mode, draws):
    x, weight = importance(post, mode, 5, 20_000)
    assert 1 / (weight**2).sum() > 0.6 * len(x)  # the proposal is close, so its weights are even
    mean = weight @ x
    sd = np.sqrt(weight @ (x - mean) ** 2)
    flat = draws.scales.reshape(-1, 6)
    assert draws.converged and draws.ess >= MIN_ESS
    assert np.abs((flat.mean(axis=0) - mean) / sd * np.sqrt(draws.ess)).max() < 5
    for i, order in enumerate(np.argsort(x, axis=0).T):  # tails are too heavy to compare deviations
        for q in (0.05, 0.25, 0.75, 0.95):
            expected = x[order, i][np.searchsorted(np.cumsum(weight[order]), q)]
            assert np.mean(flat[:, i] < expected) == pytest.approx(q, abs=0.03)


def test_unknowns_have_the_moments_of_their_mixture_of_gaussians(post, mode, draws):
    """By importance sampling of the scales, unknowns given them in closed form."""
    x, weight = importance(post, mode, 6, 4000)
    means, chols = post.given(x)
    num = len(post.design.unknowns)
    inverse = np.linalg.inv(chols)[:, :, :num]
    variances = (inverse**2).sum(axis=1)
    mean = weight @ means[:, :num]
    sd = np.sqrt(weight @ (variances + (means[:, :num] - mean) ** 2))
    np.testing.assert_allclose((draws.flat.mean(axis=0) - post.reference - mean) / sd, 0.0, atol=0.1)
    np.testing.assert_allclose(draws.flat.std(axis=0), sd, rtol=0.08)


def test_a_poorly_determined_property_follows_its_log_normal_prior():
    """One observation of a weight with a noise of 60 %: the density on a grid, prior times likelihood."""
    design = make_design(num_trials=1, objects=("left",), count=1e6)
    design, *_ = drawn(design, 0, scales=np.array([0.0] * 3 + [-8.0] * 3))
    design = replace(design, mean=np.array([0.3, 0.02, 0.015]), variance=np.array([0.18**2, 1e-12, 1e-12]),
                     coefficients=np.eye(3))  # fmt: skip
    found = sample(posterior(design), seed=0).flat[:, 0]
    grid = np.linspace(1e-4, 2.0, 40_000)
    density = np.exp(-0.5 * ((grid - 0.3) / 0.18) ** 2 + priors.log_prior("weight", np.array([1]), grid))
    cumulative = np.cumsum(density) / density.sum()
    assert (found > 0).all()
    for q in (0.1, 0.5, 0.9):
        expected = grid[np.searchsorted(cumulative, q)]
        assert np.mean(found < expected) == pytest.approx(q, abs=0.03)


def test_draws_that_only_the_prior_decides_do_not_pass_as_converged():
    """Observations below zero: hardly a draw is positive, or none."""
    design = make_design(num_trials=1, objects=("left",))

    def found(weight, sd):
        bad = replace(design, mean=np.array([weight, 0.02, 0.015]), variance=np.array([sd**2, 1e-12, 1e-12]))
        return sample(posterior(bad), seed=0)

    hardly, never = found(-0.5, 0.2), found(-2.0, 0.3)
    assert hardly.prior_ess < 0.05 and not hardly.converged and "have" in hardly.shortfall
    assert "R-hat" not in hardly.shortfall and "effective sample size" not in hardly.shortfall
    assert never.impossible == (0,) and never.flat[:, 0].mean() == pytest.approx(-2.0, abs=0.1)
    assert never.converged and (never.flat[:, 1:] > 0).all()


def test_systematic_resampling_keeps_the_weights():
    weight = np.random.default_rng(0).dirichlet(np.ones(50))
    big = np.concatenate([np.repeat(weight / 200, 200)])
    index = sampler._resampled(big, np.random.RandomState(0))
    np.testing.assert_allclose(np.bincount(index // 200, minlength=50) / big.size, weight, atol=1.1 / 10_000)
    assert (np.diff(index) >= 0).all()


def test_the_same_seed_draws_the_same(post, draws):
    again, other = sample(post, seed=1), sample(post, seed=2)
    np.testing.assert_array_equal(again.chain, draws.chain)
    assert not np.array_equal(other.chain[:, :10], draws.chain[:, :10])


def test_density_of_the_proposal_integrates_to_one(post, mode):
    """The mean of p / q over q's draws, p a Gaussian narrower than q, is 1."""
    found = proposal(post, mode)
    draws = found.draw(40_000, np.random.RandomState(1))
    chol = np.linalg.cholesky(0.3 * mode.covariance)
    z = np.linalg.solve(chol, (draws - mode.scales).T)
    log_normal = -0.5 * (z**2).sum(axis=0) - 0.5 * len(z) * np.log(2 * np.pi)
    ratio = np.exp(log_normal - np.log(np.diag(chol)).sum() - found.log_density(draws))
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(ratio.size)) and ratio.std() < 30


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_effective_sample_size_of_a_chain_with_known_autocorrelation(rho):
    chain = ar1((40, 3000), rho, np.random.default_rng(0))
    expected = chain.size * (1 - rho) / (1 + rho)
    assert effective_sample_size(chain) == pytest.approx(
        expected, rel=0.15
    )  # the window of 5 tau loses 1 % or more


def test_rhat_against_its_definition_and_drift():
    """Groups whose means differ by d standard deviations: 1 + var(means) / 1."""
    rng = np.random.default_rng(3)
    chain = rng.normal(size=(4 * GROUPS, 2000, 1))
    assert split_rhat(chain) == pytest.approx(1.0, abs=2e-3)
    shift = np.repeat(np.arange(GROUPS) * 0.5, 4)[:, None, None]
    means = np.repeat(np.arange(GROUPS) * 0.5, 2)  # both halves
    assert split_rhat(chain + shift) == pytest.approx(np.sqrt(1 + means.var(ddof=1)), rel=0.02)
    drift = np.linspace(-1, 1, 2000)[None, :, None]
    assert split_rhat(chain + drift) > 1.1


@pytest.mark.parametrize("share", [1e-3, 0.3])
def test_a_scatter_of_any_size_is_sampled(share):
    """Pads that differ by 30 % between grips where 0.1 % is usual: found, and sampled as well."""
    scales = np.zeros(6)
    scales[4] = np.log(share / priors.SCATTER_MEDIAN[1])
    design, true, *_ = drawn(make_design(num_trials=4), 7, scales=scales)
    found = sample(posterior(design), seed=0)
    assert found.converged
    x, weight = importance(posterior(design), find_mode(posterior(design)), 7, 4000)
    mean = weight @ x
    apart = found.scales.mean(axis=(0, 1)) - mean
    assert np.abs(apart / np.sqrt(weight @ (x - mean) ** 2)).max() < 0.2
    width = found.flat[:, 1]
    assert abs(width.mean() - true[1]) < 4 * width.std() and width.std() > 0.2 * share * UNIT[1]
