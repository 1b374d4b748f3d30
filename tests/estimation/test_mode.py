"""The mode of the scales is a mode, and finds the scatter that was planted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import SD, UNIT, drawn, make_design
from scipy.optimize import minimize

from estimation import priors
from estimation.posterior import find_mode, log_density, padded, posterior


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


@pytest.mark.parametrize("deviations", [0, 2])
def test_scipy_finds_the_same_mode(deviations):
    post = posterior(drawn(make_design(deviations=deviations), 5)[0])
    mode = find_mode(post)
    found = minimize(lambda x: -post.log_prob(x[None])[0], np.zeros(6), method="BFGS", options={"gtol": 1e-5})
    np.testing.assert_allclose(mode.scales, found.x, atol=2e-4)


def test_padding_changes_no_density():
    post = posterior(drawn(make_design(deviations=2), 6)[0])
    theta = np.random.default_rng(0).normal(size=(5, 6))
    more = padded(post.tables, 8)
    assert len(more.hand) == len(post.tables.hand) + 6
    np.testing.assert_allclose(log_density(theta, more), post.log_prob(theta), rtol=1e-12)


def test_jax_and_numpy_agree_on_the_density():
    post = posterior(drawn(make_design(deviations=2), 7)[0])
    theta = 3 * np.random.default_rng(0).normal(size=(200, 6))
    found = log_density(jnp.asarray(theta), jax.tree.map(jnp.asarray, post.tables), jnp)
    np.testing.assert_allclose(found, post.log_prob(theta), rtol=1e-10)
    assert 0 < np.isinf(found).sum() < 20  # beyond the farthest as well


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


def test_without_scatter_the_means_error_is_that_of_the_sensors():
    design, *_ = drawn(make_design(num_trials=12, count=1e6), 3, scales=np.array([0.0] * 3 + [-6.0] * 3))
    mode = find_mode(posterior(design))
    own = design.variance[(design.channel == 0) & (design.move == 0)]
    sensors = 1 / np.sqrt((1 / own).sum())
    assert sensors < np.sqrt(mode.unknowns_covariance[0, 0]) < 1.3 * sensors
    assert sensors == pytest.approx(SD[0] / np.sqrt(12), rel=0.3)
