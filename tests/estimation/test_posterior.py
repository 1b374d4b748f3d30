"""The posterior against one dense Gaussian, its mode and sampler; friction and pads against planted ones."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import UNIT, drawn, make_design
from hand_signals import signals_of

from estimation import friction, priors, sampler
from estimation.friction import friction_posteriors, largest_ratio
from estimation.observations import WeighedTrial, subtask_masks
from estimation.pads import MISSTATED, SLOPE_SD, UNSTATED, landing, misstated, possible_share
from estimation.pads import slope as slope_amid
from estimation.posterior import find_mode, log_density, log_prior, posterior
from estimation.sampler import GROUPS, MIN_ESS, proposal, sample, split_rhat
from hmmseg.contact.decompose import FREE, subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Fingertip, Rig, Systematic
from hmmseg.io.task import BlockTask, parse_task

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


SD = 0.012  # N
RIG = Rig(fingertip=Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0))
LIFT = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [{"object": "cup", "to": "ground"}]})
SLIDE = {"object": "cup", "to": "ground", "slide": True}
SLID = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [SLIDE]})
BOTH = parse_task({"objects": {"cup": {"on": "ground"}}, "moves": [SLIDE, {"object": "cup", "to": "ground"}]})
DURATION, RATE = 1.0, 20.0  # s of each subtask, samples per second
NUM = int(5 * DURATION * RATE)


def aligned(signals: Signals, task: BlockTask, boundaries: np.ndarray) -> WeighedTrial:
    """A trial of given boundaries (num_alignments, num_subtasks - 1) [s], its weights plain means."""
    steps = subtasks(task)
    masks = subtask_masks(signals.t, boundaries, len(steps))
    free = masks[0][[s.index for s in steps if s.state == FREE]].any(axis=0)
    grips, counts = {}, {}
    for s in steps:
        if s.name == "carry":
            inside = masks[:, s.index].astype(float)
            grips[s.move] = {"force": inside / np.maximum(inside.sum(axis=1, keepdims=True), 1)}
            counts[s.move] = {"force": inside.sum(axis=1)}
    uniform = free / max(free.sum(), 1)
    robust = np.tile(uniform, (4, 1))
    return WeighedTrial(signals, masks, grips, counts, uniform, robust, float(free.sum()))


def planted(
    task: BlockTask, ratio: np.ndarray, rng: np.random.Generator, *, normal: float = 1.5, bias: float = 0.0,
    slip: np.ndarray | None = None,
) -> WeighedTrial:  # fmt: skip
    """A trial with true ratios (num_timesteps,) while held; `slip` [m] moves the anchors."""
    steps = subtasks(task)
    boundaries = DURATION * np.arange(1, len(steps))[None]
    t = np.arange(int(len(steps) * DURATION * RATE)) / RATE
    state = np.array([s.state != FREE for s in steps])[np.minimum((t / DURATION).astype(int), len(steps) - 1)]
    grip, shear = np.where(state, normal, 0.0), np.where(state, ratio * normal, 0.0)
    y = 0.02 + shear / RIG.fingertip.shear_stiffness + (np.zeros(t.size) if slip is None else slip)

    def noisy(values: np.ndarray, sd: float = SD, offset: float = 0.0) -> np.ndarray:
        return values + offset + sd * rng.standard_normal(t.size)

    signals = signals_of(t, SD, y1=noisy(y, 2.5e-5), fx1=noisy(grip, offset=bias),
                         fy1=noisy(shear, offset=bias), y2=noisy(y, 2.5e-5), fx2=noisy(-grip, offset=bias),
                         fy2=noisy(shear, offset=bias), sd_x=2.5e-5, sd_y=2.5e-5)  # fmt: skip
    return aligned(signals, task, boundaries)


@pytest.mark.parametrize("limit", [np.inf, 0.3])
def test_lower_bound_covers_the_largest_true_ratio_and_is_close(limit):
    """The naive maximum exceeds the truth nearly always; the 5 % quantile hardly ever."""
    rng = np.random.default_rng(1)
    below, gap, naive = [], [], []
    for _ in range(60):
        paths = [np.abs(0.2 + np.cumsum(rng.normal(0, 0.02, 20))) for _ in range(10)]
        ratio = np.minimum(np.concatenate(paths), limit)
        sd = 0.0085 * rng.uniform(0.7, 1.5, ratio.size)
        seen = np.abs(ratio + sd * rng.standard_normal(ratio.size))
        bound = np.quantile(largest_ratio(seen, sd, np.ones((1, ratio.size), bool), rng, 500), 0.05)
        below.append(bound <= ratio.max())
        gap.append(ratio.max() - bound)
        naive.append(seen.max() > ratio.max())
    assert np.mean(below) >= 0.9 and np.mean(naive) > 0.6 and np.median(gap) < 0.045


def test_one_sample_does_not_carry_the_bound_and_alignments_are_marginalised():
    rng = np.random.default_rng(2)
    ratio, sd = np.abs(0.2 + 0.01 * rng.standard_normal(100)), np.full(100, 0.01)
    ratio[50] = 0.9
    draws = largest_ratio(ratio, sd, np.ones((1, 100), bool), rng, 1000)
    assert np.quantile(draws, 0.05) < 0.3 and draws.max() > 0.8
    rng = np.random.default_rng(3)
    ratio = np.concatenate([np.full(40, 0.2), np.full(10, 0.5)]) + 0.005 * rng.standard_normal(50)
    held = np.ones((16, 50), bool)
    held[::2, 40:] = False
    draws = largest_ratio(ratio, np.full(50, 0.005), held, rng, 2000)
    assert np.mean(draws > 0.45) == pytest.approx(0.5, abs=0.1)
    assert np.median(draws[draws < 0.45]) == pytest.approx(0.2, abs=0.01)


def test_bias_is_removed_uncertain_gain_widens_the_bound_and_nothing_held_gives_a_reason():
    rng = np.random.default_rng(4)
    ratio = np.where(np.arange(NUM) % 20 < 10, 0.25, 0.1)
    found = friction_posteriors([planted(LIFT, ratio, rng, bias=0.15)], LIFT, RIG, SD, rng)["cup"]
    assert found.bound_draws is not None and np.median(found.bound_draws) == pytest.approx(0.25, abs=0.006)
    assert found.lower_bound == np.quantile(found.bound_draws, 0.05) <= 0.25
    rng = np.random.default_rng(5)
    trial = planted(LIFT, np.full(NUM, 0.25), rng)
    rig = RIG.model_copy(update={"systematic": Systematic(force_gain=(0.05,) * 4)})
    found = friction_posteriors([trial], LIFT, rig, SD, rng)["cup"].bound_draws
    assert found.std() / found.mean() == pytest.approx(np.hypot(0.05, 0.05), rel=0.15)
    rng = np.random.default_rng(6)
    trial = planted(LIFT, np.full(NUM, 0.25), rng, normal=0.0)
    found = friction_posteriors([trial], LIFT, RIG, SD, rng)["cup"]
    assert found == friction.FrictionPosterior(None, reason="the recording never shows cup held firmly")
    assert found.to_json() == {"unit": "1", "lower_bound": None}


def stretches(rng: np.random.Generator, num: int, mu: float | None, drift: float = 0.0,
              scale: float = 2.5e-5) -> list[friction.Stretch]:  # fmt: skip
    """Fingers on a resting block under growing shear; beyond `mu` they slip at 3 mm/s."""
    out = []
    for _ in range(num):
        t = np.arange(12) * 0.05
        ratio = -np.linspace(0.1, rng.uniform(0.3, 0.5), 12)
        anchor = drift * np.cumsum(rng.standard_normal(12)) * np.sqrt(0.05)
        if mu is not None:
            anchor = anchor - 3e-3 * 0.05 * np.cumsum(np.abs(ratio) > mu)
            ratio = np.maximum(ratio, -mu)
        noise = rng.standard_normal((2, 12))
        out.append(friction.Stretch(t, anchor + scale * noise[0], np.full(12, scale), 1.5 * ratio,
                           ratio + 0.008 * noise[1], np.full(12, 0.008), 4e-4))  # fmt: skip
    return out


@pytest.mark.parametrize(("mu", "drift", "seen"), [(0.25, 0.0, True), (0.25, 3e-5, True), (None, 0.0, False),
                                                  (None, 2e-4, False)])  # fmt: skip
def test_slip_is_seen_where_it_was_planted(mu, drift, seen):
    rng = np.random.default_rng(7)
    for _ in range(6):
        own = stretches(rng, 8, mu, drift)
        bound = np.full(100, mu or max(np.abs(s.ratio).max() for s in own))
        found = friction.slip_evidence(own, stretches(rng, 8, None, drift), bound)
        assert found.seen is seen and (found.probability > 0.5) is seen


def test_one_odd_stretch_is_no_slip():
    """A jump that comes back, at the highest ratio, as a wrong boundary makes it."""
    rng = np.random.default_rng(8)
    own = stretches(rng, 8, None)
    best = int(np.argmax([np.abs(s.ratio).max() for s in own]))
    own[best].anchor[-3:] += [5e-4, -3e-4, 6e-4]
    bound = np.full(100, np.abs(own[best].ratio).max())
    assert not friction.slip_evidence(own, [], bound).seen


def test_planted_slip_tells_mu():
    rng, mu = np.random.default_rng(9), 0.3
    trials, others = [], []
    for _ in range(4):
        free = -np.tile(np.linspace(0.1, rng.uniform(0.35, 0.45), 20), 5)
        moved = -2e-3 / RATE * np.cumsum(np.abs(free) > mu)
        trials.append(planted(LIFT, np.maximum(free, -mu), rng, slip=moved))
        others.append(planted(LIFT, free, rng))
    slipped = friction_posteriors(trials, LIFT, RIG, SD, rng)["cup"]
    assert slipped.slip.seen and slipped.reason is None
    low, high = slipped.to_json()["interval_95"]
    assert low < mu < high and high - low < 0.05
    assert slipped.lower_bound is not None and slipped.lower_bound <= mu
    stuck = friction_posteriors(others, LIFT, RIG, SD, rng)["cup"]
    assert stuck.mu_draws is None and "mean" not in stuck.to_json()
    assert stuck.reason == "no finger was seen to slip on cup: a bound is all it tells"


@pytest.mark.parametrize(("task", "close"), [(SLID, 0.12), (BOTH, 0.03)])
def test_sliding_tells_the_friction_of_the_support(task, close):
    rng, mu, weight = np.random.default_rng(10), 0.5, 0.6
    z = []
    for _ in range(8):
        wander = np.abs(0.15 + np.cumsum(rng.normal(0, 0.015, len(subtasks(task)) * 20)))
        trial = planted(task, wander, rng)
        s, steps = trial.signals, subtasks(task)
        index = np.minimum((s.t / DURATION).astype(int), len(steps) - 1)
        sliding = np.array([step.name == "slide" for step in steps])[index]
        carried = np.array([step.name == "carry" for step in steps])[index]
        down = np.where(carried, weight, np.where(sliding, 0.25 * np.sin(9 * s.t), 0.0))
        push = np.where(sliding, mu * (weight - down), 0.0)
        noise = SD * rng.standard_normal((4, s.t.size))
        held = trial.masks[0][[step.index for step in steps if step.state != FREE]].any(axis=0) * 1.5
        vars(s).update(fx1=held + push + noise[0], fx2=-held + noise[1], fy1=down / 2 + noise[2],
                       fy2=down / 2 + noise[3], vx1=sliding * 0.1, vx2=sliding * 0.1)  # fmt: skip
        known = {"cup": rng.normal(weight, 0.01, 500)} if carried.any() else {}
        ground = friction_posteriors([trial], task, RIG, SD, rng, known)["cup"].ground
        assert ground.support == "ground" and ground.mu_draws.mean() == pytest.approx(mu, abs=close)
        z.append((ground.mu_draws.mean() - mu) / ground.mu_draws.std())
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2.0


def test_intervals_hold_however_few_samples_a_slide_has(monkeypatch):
    rng, mu, weight, inside = np.random.default_rng(3), 0.5, 0.6, []
    down, lag = 0.3 * np.linspace(-1, 1, 6), 0.05 * np.array([1, -1, 0, 0, -1, 1])
    for _ in range(400):
        push = mu * (weight - down) + weight * lag + 0.01 * rng.standard_normal(6)
        monkeypatch.setattr("estimation.friction._rows", lambda *_, p=push: np.stack([p, lag, down], axis=1))
        slid = [planted(SLID, np.zeros(100), rng)]
        found = friction.ground_friction(slid, SLID, subtasks(SLID), "cup", RIG, None, rng)
        low, high = np.percentile(found.mu_draws, [2.5, 97.5])
        inside.append(low < mu < high)
    assert np.mean(inside) > 0.92


DT = 0.02
STEP = 0.01
TOUCH = 0.503  # s, between two samples
STIFFNESS = 2500.0  # N/m, of both pads' mean shear


def grip(share=0.0, lag=0.0, noise=0.0, seed=0):
    """Times, give [m] and reading of a grip; `share` of the give is left out, which comes `lag` s late."""
    t = np.arange(0.0, 3.0, DT)

    def give(at):
        return 1.2e-3 * np.clip(np.minimum((at - 0.2) / 0.3,
                                           (2.8 - at) / 0.3), 0, 1) * (1 + 0.05 * np.sin(4 * at))  # fmt: skip

    recorded = give(t - lag)
    reading = 0.02 - (1 + share) * give(t) + recorded
    return t, recorded, reading + noise * np.random.default_rng(seed).normal(size=t.size)


def slope(t, reading, recorded, groups, noise, sds=(0.0, 0.0)):
    """Of a width's reading: places alone are short of it by the give."""
    return slope_amid(t, reading, recorded - reading, recorded, groups, noise, sds)


def held(recorded):
    return [recorded > 0.15 * np.median(recorded)]


@pytest.mark.parametrize("share", [0.0, 0.3, -0.2])
def test_a_share_left_out_is_the_slope(share):
    t, recorded, reading = grip(share)
    found = slope(t, reading, recorded, held(recorded), 1e-7)
    assert found.weights @ reading == pytest.approx(-share, abs=1e-6)
    np.testing.assert_allclose(found.weights @ np.full(t.size, 5.0), 0.0, atol=1e-6)  # no level enters
    assert found.variance < (1e-3 * SLOPE_SD) ** 2


def test_late_forces_and_single_samples_make_no_softer_pad():
    t, recorded, reading = grip(lag=0.03)
    closing = [held(recorded)[0] & (t < 1.5)]
    found = slope(t, reading, recorded, closing, 1e-7)
    plain = np.polyfit(recorded[closing[0]], reading[closing[0]], 1)[0]
    assert abs(found.weights @ reading) < 0.03 < 0.08 < abs(plain)
    t, recorded, reading = grip(noise=1e-5)
    one = (recorded > 0.95 * recorded.max()) | (np.arange(t.size) == 14)
    reading = reading + np.where(np.arange(t.size) == 14, 3e-4, 0.0)
    found = slope(t, reading, recorded, [one], 1e-5)
    assert abs(found.weights @ reading) < 3 * np.sqrt(found.variance)


def test_noise_has_the_variance_that_is_stated_and_too_few_samples_tell_nothing():
    t, recorded, _ = grip()
    readings = [grip(noise=3e-5, seed=k)[2] for k in range(200)]
    slopes = [slope(t, reading, recorded, held(recorded), 1e-5, (0.0, 3e-5)) for reading in readings]
    values = [s.weights @ reading for s, reading in zip(slopes, readings, strict=True)]
    stated = np.sqrt(np.mean([s.variance for s in slopes]))
    assert np.std(values) == pytest.approx(stated, rel=0.35)
    t, recorded, reading = grip()
    assert slope(t, reading, recorded, [np.arange(t.size) < 5], 1e-5) is None
    assert slope(t, reading, 0 * recorded, held(recorded + 1), 1e-5) is None
    t, reading, give, _ = landed()
    assert landing(t, reading, give, place_of(t), (TOUCH, 0.0), (t > 0.48) & (t < TOUCH), 1e-6) is None
    assert landing(t, reading, 0 * give, place_of(t), (TOUCH, 0.0), t < TOUCH, 1e-6) is None


def test_forces_that_ring_make_a_slope_doubtful_and_no_stiff_pad():
    """Ringing that the rig does not state, while places follow the true pads: the flat line says no give."""
    t, recorded, reading = grip()
    ring = 1.5e-4 * np.sin(1000 * t**2)
    groups = [held(recorded)[0] & (t > 0.6) & (t < 2.4)]  # the ramps, which say more, left out
    found = slope(t, reading + ring, recorded + ring, groups, 1e-5, (0.0, 2e-5))
    flat = np.polyfit((recorded + ring)[groups[0]], (reading + ring)[groups[0]], 1)[0]
    assert flat > 0.8
    assert found.alike > 0.25 and abs(found.weights @ (reading + ring)) < 2.5 * np.sqrt(found.variance)
    clean = slope(t, reading, recorded, groups, 1e-5, (0.0, 2e-5))
    assert clean.alike < 0.15 and abs(clean.weights @ reading) < 0.02


def test_what_the_rig_does_not_admit_counts_by_its_odds_and_unstated_pads_as_slopes_show():
    shares, variances = np.array([0.6, 0.65, 0.55, 0.6]), np.full(4, 0.02**2)
    share, odds = misstated(shares, variances, True, 0.0)
    assert share == pytest.approx(0.6) and odds > 0.99
    assert misstated(shares, variances, True, 0.6) == (0.0, 0.0)  # the rig says so itself
    _, doubtful = misstated(0.5 * shares, variances, True, 0.0)
    assert MISSTATED < doubtful < odds
    assert misstated(shares, variances, True, 0.0, apart=0.6) == (0.0, 0.0)  # all off for one reason
    assert misstated(0.1 * shares, variances, True, 0.0) == (0.0, 0.0)  # they speak for the rig
    assert misstated(0.8 * shares, variances, False, 0.0)[1] > 0.5  # of rigid pads any give is a surprise
    assert misstated(np.array([]), np.array([]), True, 0.0) == (0.0, 0.0)
    nothing = np.zeros(0)
    assert possible_share(nothing, nothing) == UNSTATED
    rigid = possible_share(np.zeros(4), np.full(4, 0.02**2))
    assert rigid == pytest.approx(0.02 * np.sqrt(np.pi / 8))  # the error of a median of four
    assert possible_share(np.array([0.3]), np.array([0.1**2])) == pytest.approx(0.3)
    assert possible_share(np.array([0.0]), np.array([9.0])) == UNSTATED  # a slope that tells nothing
    assert possible_share(np.array([3.0]), np.array([0.01])) == pytest.approx(3.0)


def landed(share=0.0, creep=0.0, noise=0.0, seed=0):
    """Times, block_y by nominal pads, their give, net force; the true is 1 + `share` times it."""
    t = np.arange(0.0, 1.0, STEP)
    way = np.where(t < TOUCH, 0.0, 1 - np.exp(-(t - TOUCH) / 0.03))
    net = 0.5 - 2.0 * way
    give = -net / STIFFNESS  # shear gives the fingers' height against the block
    # the block lies still after the touch; the fingers are where their pads have it, less what crept
    block = np.where(t < TOUCH, 0.02 + 0.05 * (TOUCH - t) + 0.1 * (TOUCH - t) ** 2, 0.02)
    reading = block + share * give - creep * way
    return t, reading + noise * np.random.default_rng(seed).normal(size=t.size), give, net


def place_of(t):
    weights = (t > 0.7).astype(float)
    return weights / weights.sum()


@pytest.mark.parametrize("share", [0.0, 0.4, -0.3, 2.0])
def test_a_share_left_out_is_found(share):
    t, reading, give, _ = landed(share)
    found = landing(t, reading, give, place_of(t), (TOUCH, 0.0), t < TOUCH, 1e-6)
    assert found.weights @ reading == pytest.approx(share, abs=2e-3)
    np.testing.assert_allclose(found.weights @ np.full(t.size, 0.3), 0.0, atol=1e-9)  # no level enters


def test_creep_counts_with_all_it_crept_and_the_variance_is_that_of_noise_and_moment():
    t, reading, give, _ = landed(creep=4e-4)
    found = landing(t, reading, give, place_of(t), (TOUCH, 0.0), t < TOUCH, 1e-6)
    assert found.weights @ reading == pytest.approx(-4e-4 / (give[-1] - give[0]), rel=0.01)
    rng, found = np.random.default_rng(1), []
    for k in range(300):
        t, reading, give, _ = landed(0.5, noise=2e-5, seed=k)
        one = landing(t, reading, give, place_of(t), (TOUCH + 1e-3 * rng.normal(), 1e-3), t < 0.49, 2e-5)
        found.append((one.weights @ reading, one.variance))
    values, variances = np.array(found).T
    assert np.mean(values) == pytest.approx(0.5, abs=0.02)
    assert np.std(values) <= np.sqrt(np.mean(variances)) <= 5 * np.std(values)
