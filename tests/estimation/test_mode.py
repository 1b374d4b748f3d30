"""The mode is found from wrong starts, and is a mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import SD, TRUE, make_design, start_of

from estimation.mode import find_mode
from estimation.posterior import log_likelihoods, mean_log_prob, pack


@pytest.mark.parametrize("offset", [-1.0, -0.1, 0.7])
def test_planted_properties_are_recovered_from_wrong_starts(offset):
    design = make_design(spread=0.2)
    mode = find_mode(start_of(design, offset), pack(design))
    assert mode.converged
    z = (np.exp(mode.x[:3]) - TRUE) / (SD / np.sqrt(4))
    assert np.abs(z).max() < 4
    best = find_mode(start_of(design), pack(design))
    np.testing.assert_allclose(mode.x[:3], best.x[:3], atol=2e-5)


def test_the_mode_is_stationary_and_its_covariance_the_inverse_curvature():
    design = make_design(spread=0.2)
    data = pack(design)
    mode = find_mode(start_of(design, 0.1), data)
    x = jnp.asarray(mode.x)
    gradient = np.asarray(jax.grad(mean_log_prob)(x, data))
    sd = np.sqrt(np.diag(mode.covariance))
    assert np.abs(gradient * sd).max() < 1e-2  # per posterior standard deviation
    hessian = np.asarray(jax.hessian(mean_log_prob)(x, data))
    product = -hessian @ mode.covariance
    np.testing.assert_allclose(product * sd[None, :] ** -1 * sd[:, None], np.eye(sd.size), atol=1e-5)


def test_alignments_are_referred_to_the_mode():
    design = make_design(spread=0.5)
    mode = find_mode(start_of(design), pack(design))
    np.testing.assert_allclose(mode.data.reference, log_likelihoods(jnp.asarray(mode.x), mode.data))
