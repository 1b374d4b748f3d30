"""The marginal posterior against one dense Gaussian, its mode, its sampler and measures of convergence."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import UNIT, ar1, drawn, make_design

from estimation import priors, sampler
from estimation.pads import SLOPE_SD
from estimation.posterior import find_mode, log_density, log_prior, posterior
from estimation.sampler import GROUPS, MIN_ESS, effective_sample_size, proposal, sample, split_rhat

FLAT = 1e3  # sd of a prior that is flat against a width of micrometres, but not so flat that digits go


def flat_sd(design):
    """Deviations (num_unknowns,) of a flat prior: FLAT times those of what each unknown is seen by."""
    return FLAT * np.array([np.sqrt(design.variance[c != 0].mean()) for c in design.coefficients.T])


def dense(design, theta, reference):
    """Rows, prior covariance, noise and data of (unknowns less the reference, deviations, shares) jointly."""
    d = design
    share = priors.SCATTER_MEDIAN * np.exp(theta[3:])
    sd_e = np.hypot(priors.COMMON, share)
    rows = np.concatenate([d.coefficients, d.shifts, d.unit[:, None] * np.eye(3)[d.channel]], axis=1)
    free = np.zeros((d.free_mean.size, rows.shape[1]))
    free[:, len(d.unknowns) : -3] = d.free_shifts.reshape(d.free_mean.size, len(d.nuisances))
    every = np.concatenate([rows, free])
    prior = np.diag(np.concatenate([flat_sd(d), np.ones(len(d.nuisances)), sd_e]) ** 2)
    noise = np.exp(2 * theta[d.channel]) * d.variance + (share[d.channel] * d.unit) ** 2
    noise = np.concatenate([noise, d.free_variance.ravel()])
    data = np.concatenate([d.mean - d.coefficients @ reference, d.free_mean.ravel()])
    return every, prior, noise, data


def log_normal(data, covariance):
    sign, log_det = np.linalg.slogdet(covariance)
    assert sign > 0
    return -0.5 * (data @ np.linalg.solve(covariance, data) + log_det + data.size * np.log(2 * np.pi))


def some_scales(num, seed=3):
    rng = np.random.default_rng(seed)
    return np.concatenate([0.3 * rng.normal(size=(num, 3)), 1.5 * rng.normal(size=(num, 3))], axis=1)


@pytest.mark.parametrize("deviations", [0, 2])
def test_the_conditional_gaussian_is_that_of_the_joint_one(deviations):
    design, *_ = drawn(make_design(deviations=deviations), 2)
    post, theta = posterior(design), some_scales(3)
    means, chols = post.given(theta)
    kept = slice(0, means.shape[1] - 3)  # without what slopes have alike: there are none
    for row, mean, chol in zip(theta, means[:, kept], chols[:, kept, kept], strict=True):
        every, prior, noise, data = dense(design, row, post.reference)
        gain = prior @ every.T @ np.linalg.inv(every @ prior @ every.T + np.diag(noise))
        covariance, found = prior - gain @ every @ prior, np.linalg.inv(chol @ chol.T)
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(mean / scale, gain @ data / scale, atol=1e-2)
        np.testing.assert_allclose(found / np.outer(scale, scale), covariance / np.outer(scale, scale),
                                   atol=1e-2)  # fmt: skip


def test_a_channel_without_observations_keeps_its_prior():
    design, *_ = drawn(make_design(objects=("left",)), 4)
    kept = design.channel < 2
    less = {k: getattr(design, k)[kept]
            for k in ("mean", "variance", "shifts", "channel", "unit", "trial", "move", "slope")}  # fmt: skip
    cut = replace(design, unknowns=design.unknowns[:2], coefficients=design.coefficients[kept][:, :2], **less)
    post, theta = posterior(cut), np.zeros((3, 6))
    theta[:, 5] = (0.0, 1.0, -2.0)
    found = post.log_prob(theta)
    np.testing.assert_allclose(found - found[0], -0.5 * theta[:, 5] ** 2, atol=1e-9)
    assert cut.repeats().tolist() == [3, 3, 0]
    mean, _ = post.given(theta)
    np.testing.assert_allclose(mean[:, -4], 0.0)  # the share of a channel that shows nothing


@pytest.mark.parametrize("terms", [(1,), (1, 1), (1, 2)])
def test_prior_of_a_sum_against_drawn_sums(terms):
    """Fenton's log-normal has the moments of the sum; of one property it is its very prior."""
    rng = np.random.default_rng(6)
    mean, sd = np.log(priors.PROPERTY_MEDIAN["height"]), priors.PROPERTY_LOG_SD["height"]
    values = np.exp(mean + sd * rng.normal(size=(400_000, len(terms)))) @ np.array(terms)
    grid = np.linspace(1e-4, 3.0, 300_000)
    density = np.exp(priors.log_prior("height", np.array(terms), grid))
    density /= density.sum()
    assert density @ grid == pytest.approx(values.mean(), rel=0.02)
    assert density @ (grid < 0.05) == pytest.approx(np.mean(values < 0.05), abs=0.03)
    assert priors.log_prior("height", np.array(terms), np.array([-0.01]))[0] == -np.inf


def with_slopes(design, seed=11):
    """The design with a slope beside each mean of widths and heights, and what it stands for."""
    means, rng = np.flatnonzero(design.channel > 0), np.random.default_rng(seed)
    more = {"mean": 0.2 * rng.normal(size=means.size), "variance": np.full(means.size, 0.1**2),
            "coefficients": np.zeros((means.size, len(design.unknowns))),
            "shifts": 0.1 * rng.normal(size=(means.size, len(design.nuisances))),
            "channel": design.channel[means], "unit": np.ones(means.size), "trial": design.trial[means],
            "move": design.move[means], "slope": np.ones(means.size, bool)}  # fmt: skip
    joined = {k: np.concatenate([getattr(design, k), v]) for k, v in more.items()}
    return replace(design, **joined), means


@pytest.mark.parametrize(("deviations", "slopes", "close"), [(0, 0, 2e-3), (2, 0, 2e-3), (2, 1, 5e-3)])
def test_log_prob_is_the_density_of_all_observations(deviations, slopes, close):
    """Up to one constant, against one dense Gaussian; each grip's own share enters its mean and its slope."""
    plain, *_ = drawn(make_design(deviations=deviations), 1)
    design, means = with_slopes(plain) if slopes else (plain, np.zeros(0, int))
    post, theta = posterior(design), some_scales(8 if slopes else 12)
    num, expected = design.mean.size, []
    for row in theta:
        share = priors.SCATTER_MEDIAN * np.exp(row[3:])
        common = np.hypot(priors.COMMON, share)
        levers = [design.unit * (design.channel == c) for c in range(3)]
        levers += [1.0 * (design.slope & (design.channel == c)) for c in range(3)]
        sds = [*common, *np.hypot(SLOPE_SD, share)]
        rows = np.concatenate([design.coefficients, design.shifts, np.stack(levers, axis=1)], axis=1)
        prior = np.concatenate([flat_sd(plain), np.ones(deviations), sds]) ** 2
        covariance = (rows * prior) @ rows.T + np.diag(np.exp(2 * row[design.channel]) * design.variance)
        own = np.eye(num) * (share[design.channel] * design.unit) ** 2
        for k, i in enumerate(means):
            j = num - means.size + k
            own[i, j] = own[j, i] = share[design.channel[i]] ** 2 * design.unit[i]
            own[j, j] = 2 * share[design.channel[i]] ** 2
        free = design.free_shifts.reshape(design.free_mean.size, deviations)
        both = np.zeros((num + free.shape[0],) * 2)
        both[:num, :num] = covariance + own
        both[num:, num:] = free @ free.T + np.diag(design.free_variance.ravel())
        both[:num, num:] = design.shifts @ free.T
        both[num:, :num] = both[:num, num:].T
        data = np.concatenate([design.mean - design.coefficients @ post.reference, design.free_mean.ravel()])
        expected.append(log_normal(data, both))
    difference = post.log_prob(theta) - np.array(expected) - log_prior(theta, post.scale_sd)
    np.testing.assert_allclose(difference - difference[0], 0.0, atol=close)
    assert np.ptp(expected) > 5.0  # the constant is not all there is


def test_scales_beyond_all_reason_have_no_density_in_numpy_nor_in_jax():
    post = posterior(drawn(make_design(deviations=2), 1)[0])
    theta = np.zeros((7, 6))
    theta[np.arange(6), np.arange(6)] = (40.0, -40.0, 40.0, -1e3, 35.0, 1e3)
    found = post.log_prob(theta)
    assert (found[:6] == -np.inf).all() and np.isfinite(found[6])
    edge = np.array([[s * 9.0 for s in signs] for signs in ((1, 1, 1, 1, 1, 1), (-1, -1, -1, 1, 1, 1))])
    assert np.isfinite(post.log_prob(edge)).all()
    post = posterior(drawn(make_design(deviations=2), 7)[0])
    theta = 3 * np.random.default_rng(0).normal(size=(200, 6))
    found = log_density(jnp.asarray(theta), jax.tree.map(jnp.asarray, post.model), jnp)
    np.testing.assert_allclose(found, post.log_prob(theta), rtol=1e-10)
    assert 0 < np.isinf(found).sum() < 20  # beyond the farthest as well


def test_the_mode_is_stationary_and_its_covariance_the_inverse_curvature():
    design, *_ = drawn(make_design(deviations=2), 1)
    post = posterior(design)
    mode = find_mode(post)
    assert mode.converged
    h, eye = 3e-3, np.eye(6)

    def at(*steps):
        return float(post.log_prob((mode.scales + h * sum(steps))[None])[0])

    slope = [(at(e) - at(-e)) / (2 * h) for e in eye]
    np.testing.assert_allclose(slope, 0.0, atol=2e-2)
    curvature = [[(at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b)) / (4 * h * h) for b in eye] for a in eye]
    np.testing.assert_allclose(-np.array(curvature) @ mode.covariance, np.eye(6), atol=0.02)


def test_the_mode_is_found_in_a_process_of_single_precision():
    post = posterior(drawn(make_design(deviations=2), 8)[0])
    double = find_mode(post)
    with jax.enable_x64(False):
        single = find_mode(post)
        assert jnp.zeros(1).dtype == np.float32  # as it was
    np.testing.assert_array_equal(single.scales, double.scales)
    assert single.converged


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_planted_scatter_is_found_and_widens_what_it_touches(share):
    """Pads that differ by 2 % or 20 % from grip to grip, where the prior has 0.1 %."""
    plain, true, *_ = drawn(make_design(num_trials=12), 2, scales=np.zeros(6))
    scales = np.zeros(6)
    scales[4] = np.log(share / priors.SCATTER_MEDIAN[1])
    scattered, *_ = drawn(make_design(num_trials=12), 2, scales=scales)
    mode, before = find_mode(posterior(scattered)), find_mode(posterior(plain))
    found = priors.SCATTER_MEDIAN[1] * np.exp(mode.scales[4])
    assert found == pytest.approx(share, rel=0.4)
    sd, sd_before = (np.sqrt(np.diag(m.unknowns_covariance)) for m in (mode, before))
    width, weight = 1, 0
    # What all grips have alike may be as large as what differs between them.
    assert sd[width] == pytest.approx(np.hypot(found, found / np.sqrt(12)) * UNIT[1], rel=0.15)
    assert sd[weight] == pytest.approx(sd_before[weight], rel=0.2)
    assert np.abs((mode.unknowns - true) / sd).max() < 4


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


def test_scales_and_unknowns_have_the_moments_of_importance_sampling(post, mode, draws):
    x, weight = importance(post, mode, 5, 20_000)
    assert 1 / (weight**2).sum() > 0.6 * len(x)  # the proposal is close, so its weights are even
    mean = weight @ x
    sd, flat = np.sqrt(weight @ (x - mean) ** 2), draws.scales.reshape(-1, 6)
    assert draws.converged and draws.ess >= MIN_ESS
    assert np.abs((flat.mean(axis=0) - mean) / sd * np.sqrt(draws.ess)).max() < 5
    for i, order in enumerate(np.argsort(x, axis=0).T):  # tails are too heavy to compare deviations
        for q in (0.05, 0.25, 0.75, 0.95):
            expected = x[order, i][np.searchsorted(np.cumsum(weight[order]), q)]
            assert np.mean(flat[:, i] < expected) == pytest.approx(q, abs=0.03)
    x, weight = importance(post, mode, 6, 4000)
    means, chols = post.given(x)
    num = len(post.design.unknowns)
    inverse = np.linalg.inv(chols)[:, :, :num]
    variances, mean = (inverse**2).sum(axis=1), weight @ means[:, :num]
    sd = np.sqrt(weight @ (variances + (means[:, :num] - mean) ** 2))
    np.testing.assert_allclose((draws.flat.mean(axis=0) - post.reference - mean) / sd, 0.0, atol=0.1)
    np.testing.assert_allclose(draws.flat.std(axis=0), sd, rtol=0.08)


def test_a_poorly_determined_property_follows_its_log_normal_prior():
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
    design = make_design(num_trials=1, objects=("left",))

    def found(weight, sd):
        bad = replace(design, mean=np.array([weight, 0.02, 0.015]), variance=np.array([sd**2, 1e-12, 1e-12]))
        return sample(posterior(bad), seed=0)

    hardly, never = found(-0.5, 0.2), found(-2.0, 0.3)
    assert hardly.prior_ess < 0.05 and not hardly.converged and "have" in hardly.shortfall
    assert "R-hat" not in hardly.shortfall and "effective sample size" not in hardly.shortfall
    assert never.impossible == (0,) and never.flat[:, 0].mean() == pytest.approx(-2.0, abs=0.1)
    assert never.converged and (never.flat[:, 1:] > 0).all()


def test_the_proposal_is_a_density_and_the_same_seed_draws_the_same(post, draws, mode):
    weight = np.random.default_rng(0).dirichlet(np.ones(50))
    big = np.concatenate([np.repeat(weight / 200, 200)])
    index = sampler._resampled(big, np.random.RandomState(0))
    np.testing.assert_allclose(np.bincount(index // 200, minlength=50) / big.size, weight, atol=1.1 / 10_000)
    assert (np.diff(index) >= 0).all()
    again, other = sample(post, seed=1), sample(post, seed=2)
    np.testing.assert_array_equal(again.chain, draws.chain)
    assert not np.array_equal(other.chain[:, :10], draws.chain[:, :10])
    found = proposal(post, mode)
    draws = found.draw(40_000, np.random.RandomState(1))
    chol = np.linalg.cholesky(0.3 * mode.covariance)
    z = np.linalg.solve(chol, (draws - mode.scales).T)
    log_normal = -0.5 * (z**2).sum(axis=0) - 0.5 * len(z) * np.log(2 * np.pi)
    ratio = np.exp(log_normal - np.log(np.diag(chol)).sum() - found.log_density(draws))
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(ratio.size)) and ratio.std() < 30


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_effective_sample_size_of_a_chain_with_known_autocorrelation(rho):
    chain = ar1(40, 3000, rho, np.random.default_rng(0))[..., None]
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
