"""The posterior against closed forms and a plain re-implementation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_scene import NAMES, SD, TRUE, make_design, start_of
from scipy.special import logsumexp

from estimation import priors
from estimation.mode import find_mode
from estimation.posterior import log_likelihoods, log_prob, log_prob_batch, mean_log_prob, pack, split


def plain_log_prob(x, design, reference):
    """The same density, term by term."""
    num, total = len(design.names), 0.0
    properties, scale, ratio = np.exp(x[:num]), np.exp(x[num : num + 3]), np.exp(x[num + 3 : num + 6])
    common, deviations = x[num + 6 : num + 9], x[num + 9 :]
    for i in range(design.mean.shape[0]):
        terms = []
        for s in range(design.mean.shape[1]):
            value = 0.0
            for o, c in enumerate(design.channel):
                if not design.there[i, s, o]:
                    continue
                predicted = design.coefficients[i, s, o] @ properties + design.shifts[i, s, o] @ deviations
                predicted += design.common[c] * common[c]
                variance = design.variance[i, s, o] * scale[c] ** 2 + (design.tau[c] * ratio[c]) ** 2
                value -= 0.5 * (design.mean[i, s, o] - predicted) ** 2 / variance
                value -= 0.5 * np.log(2 * np.pi * variance)
            terms.append(value - reference[i, s])
        total += logsumexp(terms) - np.log(len(terms))
        if deviations.size:
            free = design.free_mean[i] - design.free_shifts[i] @ deviations
            total -= 0.5 * (free**2 / design.free_variance[i]).sum()
    mean, sd = priors.property_priors(design.names)
    total -= 0.5 * (((x[:num] - mean) / sd) ** 2).sum()
    total -= 0.5 * (x[num : num + 3] ** 2 * 2 * design.scale_count).sum()
    total -= 0.5 * ((x[num + 3 : num + 6] / priors.TAU_LOG_SD) ** 2).sum()
    return total - 0.5 * (common**2).sum() - 0.5 * (deviations**2).sum()


@pytest.mark.parametrize("deviations", [0, 2])
def test_log_prob_is_its_definition(deviations):
    design = make_design(deviations=deviations, spread=0.5)
    design.there[1, :, 2] = False
    data = pack(design)
    rng = np.random.default_rng(1)
    data = data._replace(reference=jnp.asarray(rng.normal(size=data.reference.shape)))
    x = start_of(design) + 0.01 * rng.normal(size=(6, start_of(design).size))
    x[:, 3:] += 0.5 * rng.normal(size=x[:, 3:].shape)
    expected = [plain_log_prob(row, design, np.asarray(data.reference)) for row in x]
    np.testing.assert_allclose(log_prob_batch(jnp.asarray(x), data), expected, rtol=1e-10)
    np.testing.assert_allclose([float(log_prob(jnp.asarray(row), data)) for row in x], expected, rtol=1e-10)


def test_alignments_are_marginalised_by_their_mean_likelihood():
    design = make_design(spread=1.0)
    data = find_mode(start_of(design), pack(design)).data
    x = start_of(design, 0.003)
    every, reference = np.asarray(log_likelihoods(jnp.asarray(x), data)), np.asarray(data.reference)
    prior = plain_log_prob(x, design, every)  # referred to itself every trial adds 0
    expected = np.log(np.mean(np.exp(every - reference), axis=1)).sum() + prior
    assert float(log_prob(jnp.asarray(x), data)) == pytest.approx(expected, rel=1e-10)
    expected = every.mean(axis=1).sum() + prior
    assert float(mean_log_prob(jnp.asarray(x), data)) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("num_trials", [3, 5])
def test_padding_changes_nothing(num_trials):
    """3 and 5 trials are padded to 4 and 8."""
    design = make_design(num_trials, deviations=2, spread=0.3)
    data = pack(design)
    assert data.mean.shape[0] == 1 << (num_trials - 1).bit_length()
    x = start_of(design, 0.002)
    expected = plain_log_prob(x, design, np.zeros((num_trials, 4)))
    assert float(log_prob(jnp.asarray(x), data)) == pytest.approx(expected, rel=1e-12)


def test_split_takes_the_vector_apart():
    parts = split(jnp.arange(14.0), 3)
    assert [p.tolist() for p in parts] == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [12, 13]]


def test_mode_and_covariance_are_generalised_least_squares():
    """Scales and scatter held, one alignment: a Gaussian posterior, prior all but flat against it."""
    design = make_design(deviations=2)  # all alignments say the same
    data = pack(design)
    data = data._replace(scale_sd=jnp.full(3, 1e-4), tau=jnp.full(3, 1e-12), prior_sd=jnp.full(3, 1e4))
    mode = find_mode(start_of(design, 0.05), data)
    # Unknowns: properties, common shifts and deviations (prior rows), linear.
    rows, values, sds = [], [], []
    for i in range(4):
        for o in range(3):
            common = design.common * (np.arange(3) == o)
            rows.append([*design.coefficients[i, 0, o], *common, *design.shifts[i, 0, o]])
            values.append(design.mean[i, 0, o])
            sds.append(SD[o])
        for c in range(4):
            rows.append([*np.zeros(6), *design.free_shifts[i, c]])
            values.append(design.free_mean[i, c])
            sds.append(np.sqrt(design.free_variance[i, c]))
    rows += list(np.eye(8)[3:])
    values, sds = [*values, *np.zeros(5)], [*sds, *np.ones(5)]
    whitened = np.array(rows) / np.array(sds)[:, None]
    covariance = np.linalg.inv(whitened.T @ whitened)
    solution = covariance @ whitened.T @ (np.array(values) / np.array(sds))
    assert mode.converged
    np.testing.assert_allclose(np.exp(mode.x[:3]), solution[:3], rtol=1e-6)
    np.testing.assert_allclose(mode.x[9:], solution[3:], atol=1e-4)
    keep = np.r_[0:3, 9:14]
    found = mode.covariance[np.ix_(keep, keep)]
    jacobian = np.diag([*np.exp(mode.x[:3]), *np.ones(5)])
    found = jacobian @ found @ jacobian
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(covariance)), rtol=2e-3)
    correlation = found / np.sqrt(np.outer(np.diag(found), np.diag(found)))
    expected = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(correlation, expected, atol=2e-3)


def test_gradients_are_finite_everywhere_that_walkers_go():
    design = make_design(deviations=2, spread=1.0)
    data = find_mode(start_of(design), pack(design)).data
    rng = np.random.default_rng(0)
    for scale in (0.0, 0.1, 3.0):
        x = start_of(design) + scale * rng.normal(size=start_of(design).size)
        gradient = np.asarray(jax.grad(log_prob)(jnp.asarray(x), data))
        assert np.isfinite(gradient).all()
        numeric = [
            (float(log_prob(jnp.asarray(x + h), data)) - float(log_prob(jnp.asarray(x - h), data))) / 2e-6
            for h in 1e-6 * np.eye(x.size)[:3]
        ]
        np.testing.assert_allclose(gradient[:3], numeric, rtol=1e-4, atol=1e-2 * np.abs(numeric).max())


def test_priors_are_in_the_order_of_the_names():
    mean, sd = priors.property_priors((NAMES[2], NAMES[0]))
    np.testing.assert_allclose(
        mean, np.log([priors.PROPERTY_MEDIAN["height"], priors.PROPERTY_MEDIAN["weight"]])
    )
    assert sd.tolist() == [priors.PROPERTY_LOG_SD["height"], priors.PROPERTY_LOG_SD["weight"]]
    assert np.all(np.abs(np.log(TRUE[[2, 0]]) - mean) < sd)  # a common block is no surprise
