"""What grips and landings say of pads that are known, and places of blocks that slide in them."""

import numpy as np
import pytest

from estimation.pads import MISSTATED, SLOPE_SD, UNSTATED, landing, misstated, possible_share
from estimation.pads import slope as slope_amid

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
