"""Landings on pads that are known: what the fingers' way from touch to place says of them."""

import numpy as np
import pytest

from estimation.pads import landing

DT = 0.01
TOUCH = 0.503  # s, between two samples
STIFFNESS = 2500.0  # N/m, of both pads' mean shear


def landed(share=0.0, creep=0.0, noise=0.0, seed=0):
    """Times, block_y by the nominal pads, their give, net force: lowered ever slower, then pushed down.

    The true pads give 1 + `share` times the nominal; `creep` [m]: how far they slide on under the push.
    """
    t = np.arange(0.0, 1.0, DT)
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


def test_pads_that_creep_count_with_all_they_crept():
    t, reading, give, _ = landed(creep=4e-4)
    found = landing(t, reading, give, place_of(t), (TOUCH, 0.0), t < TOUCH, 1e-6)
    assert found.weights @ reading == pytest.approx(-4e-4 / (give[-1] - give[0]), rel=0.01)


def test_its_variance_is_that_of_noise_and_of_the_moment():
    rng = np.random.default_rng(1)
    found = []
    for k in range(300):
        t, reading, give, _ = landed(0.5, noise=2e-5, seed=k)
        one = landing(t, reading, give, place_of(t), (TOUCH + 1e-3 * rng.normal(), 1e-3), t < 0.49, 2e-5)
        found.append((one.weights @ reading, one.variance))
    values, variances = np.array(found).T
    assert np.mean(values) == pytest.approx(0.5, abs=0.02)
    assert np.std(values) <= np.sqrt(np.mean(variances)) <= 5 * np.std(values)


def test_too_few_samples_before_the_touch_tell_nothing():
    t, reading, give, _ = landed()
    assert landing(t, reading, give, place_of(t), (TOUCH, 0.0), (t > 0.48) & (t < TOUCH), 1e-6) is None
    assert landing(t, reading, 0 * give, place_of(t), (TOUCH, 0.0), t < TOUCH, 1e-6) is None
