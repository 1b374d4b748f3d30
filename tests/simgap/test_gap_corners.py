"""Late, slow and yielding things at contact changes: forces before their sensor, supports that settle."""

import numpy as np
import pytest
from scipy.signal import lfilter, lsim

from simgap.effects.base import LATE, SMOOTH, YIELDING
from simgap.gap.diagnose import _summary
from simgap.gap.residuals import contact, doubt_between, shifted, sunk
from tests.simgap.test_gap_effects import performance, world_of

STEP = 0.05  # s


def _slow(force, time: float):
    """A world whose forces (N,) are all the same and pass a low-pass of `time` [s]."""
    world = world_of(performance(10 * len(force)))
    every = np.repeat(np.asarray(force)[None, :, None], 4, axis=2)
    return world._replace(force=every, smoothing=np.asarray(time), modes=np.eye(6)[SMOOTH])


def _recorded(force_of, time: float, n: int) -> np.ndarray:
    """Forces (n,) after an exact low-pass on a grid a hundred times finer."""
    fine = np.arange(100 * n) * STEP / 100
    keep = np.exp(-STEP / 100 / time)
    return np.asarray(lfilter([1 - keep], [1, -keep], force_of(fine)))[::100]


@pytest.mark.parametrize("time", [0.06, 0.15])
def test_smooth_forces_are_found_behind_a_low_pass(time):
    t = np.arange(80) * STEP

    def force(at):
        return 1.5 + np.sin(2 * np.pi * 1.5 * at)

    recorded = _recorded(force, time, 80)
    found = np.asarray(contact(_slow(recorded, time)))[0, :, 0]
    three = recorded + time * np.gradient(recorded, STEP)
    off, plain = (np.abs(z - force(t))[20:-5] for z in (found, three))
    slope = np.abs(np.diff(recorded, prepend=0))[20:-5]
    steep = slope > 0.6 * slope.max()
    assert np.sqrt((off[steep] ** 2).mean()) < 0.7 * np.sqrt((plain[steep] ** 2).mean())
    assert off.max() < 0.08  # beside a crest that falls unevenly on its samples


def test_no_force_before_the_contact_behind_a_low_pass():
    t = np.arange(60) * STEP
    onset = 20.4 * STEP

    def force(at):
        return 4.0 * np.maximum(at - onset, 0.0)

    found = np.asarray(contact(_slow(_recorded(force, 0.1, 60), 0.1)))[0, :, 0]
    assert np.abs(found[:21]).max() < 0.02 and np.abs(found - force(t))[24:-5].max() < 0.05


def test_a_corner_is_in_doubt_and_a_straight_force_is_not():
    ramp = 3.0 * np.maximum(np.arange(60) - 20, 0.0) * STEP
    variance = np.asarray(doubt_between(_slow(ramp, 0.1)))[0, :, 0]
    assert variance[18:23].max() > 1e-3 and variance[25:-5].max() < 1e-6


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_contact_between_two_samples_is_read_on_either_side_of_it(share):
    t = np.arange(40.0)
    force = 0.8 * np.maximum(t - 19.6, 0.0)
    found = np.asarray(shifted(np.asarray(force)[None, :, None], np.asarray(share)))[0, :, 0]
    true = 0.8 * np.maximum(t + share - 19.6, 0.0)
    assert np.abs(found - true)[:-3].max() < 0.03


def test_values_at_their_own_samples_are_themselves():
    # A grip that closes within one sample and goes on to close: its sides meet nowhere between the two.
    force = np.repeat([0.0, 0.01, 2.7, 3.1, 3.1, 0.4, 0.0], 2)
    for share in (0.0, 1e-9):
        found = np.asarray(shifted(np.asarray(force)[None, :, None], np.asarray(share)))[0, :, 0]
        np.testing.assert_allclose(found, force, atol=1e-6)
    jump = np.array([0.0, 0.0, 0.0, 2.7, 3.1, 3.1])
    found = np.asarray(shifted(np.asarray(jump)[None, :, None], 0.2))[0, 2, 0]
    assert found == pytest.approx(0.2 * 2.7, abs=0.05)


@pytest.mark.parametrize("steps", [0.4, 2.4])
def test_a_late_force_is_in_doubt_where_it_is_read(steps):
    world = world_of(performance(600))
    force = np.where(np.arange(60) >= 30, 2.0, 0.0)
    world = world._replace(force=np.repeat(force[None, :, None], 4, axis=2),
                           delay=np.asarray(steps) * np.median(world.t[:, 1:] - world.t[:, :-1]),
                           modes=np.eye(6)[LATE])  # fmt: skip
    variance = np.asarray(doubt_between(world))[0, :, 0]
    assert variance.argmax() == 29 - int(steps)
    # It came at any moment between the two samples: at least the variance of one that came midway.
    assert variance.max() > 0.3**2 and variance[:20].max() == 0.0


def test_smooth_values_between_samples_are_cubic():
    t = np.arange(60.0)
    found = np.asarray(shifted(np.asarray(np.sin(0.4 * t))[None, :, None], 0.5))[0, 3:-3, 0]
    wave = np.sin(0.4 * (t + 0.5))[3:-3]
    off = np.abs(found - wave)
    assert off.max() < 0.05  # a crest between two samples is taken for a blunt corner
    assert off[np.abs(wave) < 0.8].max() < 0.001


def test_a_support_settles_like_a_spring_beside_a_damper():
    n, time, give = 60, 0.04, 4e-4
    world = world_of(performance(10 * n))
    t = np.arange(n) * STEP
    carry = ((t > 1.0) & (t < 2.0)).astype(float)
    world = world._replace(give_support=np.asarray(give), support_time=np.asarray(time),
                           carry=np.asarray(carry)[None], free=np.zeros((1, n)),
                           ground=np.asarray(1 - carry)[None], modes=np.eye(6)[YIELDING])  # fmt: skip
    load = np.where(t >= 2.0, np.minimum(3.0 * (t - 2.0 + STEP), 0.8), 0.5)
    depth = np.asarray(sunk(world, np.asarray(load)[None]))[0]
    borne = load * (1 - carry)
    after = t > 1.5  # what is in the air weighs on nothing: the oracle starts from rest
    oracle = lsim(([give], [time, 1.0]), borne[after], t[after] - t[after][0])[1]
    np.testing.assert_allclose(depth[after], oracle, atol=1e-9)
    np.testing.assert_allclose(depth[t < 1.0], give * 0.5, atol=1e-9)


def test_a_parameter_whose_inverse_was_fitted_has_the_spread_of_its_interval():
    """The inverse of a normal compliance that reaches zero has no standard deviation of its own."""
    draws = 1 / np.random.default_rng(0).normal(5e-5, 1.5e-5, 2000)
    found = _summary(draws, "N/m")
    low, high = found["interval_90"]
    assert 0.1 < found["sd"] / (high - low) < 0.5
