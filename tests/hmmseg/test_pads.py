"""Pads and delays are learned from what rests: planted ones are found and told apart, none invented."""

from dataclasses import replace

import numpy as np
import pytest
from hand_signals import signals_of
from scipy.signal import lfilter

from experiments.worlds import WORLDS, Cell, World, scene, trials_of
from hmmseg.segmentation.align import segment
from hmmseg.segmentation.emissions import Parameters
from hmmseg.segmentation.pads import (
    Compliance,
    Lateness,
    Sensing,
    Squeeze,
    _compliance,
    _unfiltered,
    _while_moving,
    lateness,
    read_again,
    resampled,
)
from hmmseg.segmentation.stretches import NONE, Stretch, Toe, find_toe, fit_slope, reading, steepest

PRIOR = (2.5e-4, 0.75e-4)


def squeeze(step=0.02, compliance=2.5e-4):
    rng, fine = np.random.default_rng(0), np.arange(0, 0.8, 1e-4)
    force = 4 * np.clip(fine / 0.15, 0, 1) ** 1.5 + 0.3 * np.sin(9 * fine) * (fine > 0.15)
    t = np.arange(0.02, 0.78, step)
    load = np.interp(t, fine, force) + 0.012 * rng.standard_normal(t.size)
    clock = np.arange(0.0, 0.8, step)
    place = 0.02 - compliance * np.interp(clock, fine, force) + 2e-5 * rng.standard_normal(clock.size)
    return Stretch(t, load, step, clock, place, 2e-5, np.abs(np.gradient(place, clock)))


def test_slopes_and_toes_of_squeezes_are_found_where_there_are_any():
    load, value, _ = reading(squeeze())
    slope, information = fit_slope(load, value, 2e-5)
    assert slope == pytest.approx(2.5e-4, abs=4 * information**-0.5) and np.std(value + slope * load) < 4e-5
    assert fit_slope(load[:3], value[:3], 2e-5) == fit_slope(0 * load, value, 2e-5) == (0.0, 0.0)
    assert find_toe(releases(Toe(-4e-4, 0.8))) is NONE
    assert find_toe([]) is NONE and find_toe([(np.ones(3), np.ones(3), SD)]) is NONE


def test_loads_that_ring_while_nothing_moves_say_little_of_the_pads():
    """Half a second of ringing after one sample of the touch: the line of places over loads is flat."""
    s = squeeze(step=0.05)
    since = s.t - s.t[0]
    held = np.where(since > 0, 4.0, 1.0)  # N
    ring = 2.0 * np.sin(160 * since) * np.exp(-since / 0.3)
    place = 0.02 - 2.5e-4 * held + 2e-5 * np.random.default_rng(1).standard_normal(s.t.size)
    flat = fit_slope(held + ring, place, s.sd)
    assert flat[0] < 0.5 * 2.5e-4 and flat[1] > (0.2 * 2.5e-4) ** -2  # and sure of it
    found = _compliance([(held + ring, place, s.sd)], PRIOR, 2.0)
    assert found.value == pytest.approx(PRIOR[0], abs=found.sd) and found.sd > 0.5 * PRIOR[1]
    clean = _compliance([(held, place, s.sd)], PRIOR)
    assert clean.value == pytest.approx(2.5e-4, abs=3 * clean.sd) and clean.sd < 0.2 * PRIOR[1]


def test_a_fast_touch_tells_as_little_of_the_pads_as_is_known_of_the_delay():
    t = np.arange(5) * 0.05
    load, pace = np.array([10.9, 6.5, 6.52, 6.49, 6.5]), np.array([0.3, 0.0, 0.0, 0.0, 0.0])
    place = 0.02 - 2.5e-4 * load - 1.3e-3 * pace + 2e-5 * np.random.default_rng(1).standard_normal(5)
    s = Stretch(t, load, 0.05, t, place, 2e-5, pace)  # 1.3 ms late
    found = _compliance([_while_moving(s, 0.0, 2e-3)], PRIOR)
    assert abs(found.value - 2.5e-4) < 2 * found.sd < 2 * PRIOR[1]
    surely = _compliance([_while_moving(s, 0.0, 1e-5)], PRIOR)
    assert surely.value - 2.5e-4 > 4 * surely.sd  # had the delay been known


def segmented(world, *numbers):
    """The segmentations of trials of a world, and by how much their boundaries are off [s]."""
    for judged in trials_of(world, numbers):
        (found,) = segment([judged.trial], scene()[1], judged.rig)
        yield found, np.array([s.start for s in found.spans[1:]]) - judged.boundaries


def test_releases_of_grips_that_ring_are_not_early():
    ((_, residual),) = segmented(WORLDS["ringing 1 N"], 78004)
    assert np.abs(residual)[3::4].max() < 0.02  # 26 and 37 ms with pads taken to be rigid


def test_soft_pads_and_holds_in_which_misread_forces_pull_are_no_delay():
    t = np.arange(0.0, 0.8, 0.02)
    pulls = Squeeze(t, np.full(t.size, 0.02), np.zeros(t.size), -1.0 - 0.1 * t, 2e-5, 0.01)
    assert lateness([pulls], PRIOR) == lateness([], PRIOR) == Lateness()
    assert not lateness([whole_grip(seed=i, compliance=1.6 * COMPLIANCE) for i in range(4)], PRIOR).late


@pytest.mark.parametrize("shift", [-0.003, 0.003])
def test_a_small_delay_leaves_both_ends_of_a_contact(shift):
    s = squeeze()
    load, place, _ = reading(s, shift)
    assert load.size == place.size == s.t.size
    np.testing.assert_allclose(load, np.interp(s.t + shift, s.t, s.load), atol=0.2)  # 3 ms of a squeeze
    assert fit_slope(load, place, s.sd)[0] == pytest.approx(2.5e-4, rel=0.1)


def test_recorded_lag_is_found_and_said_and_healthy_forces_are_on_time():
    late = World("", Cell(rate=50.0), effects={"force_lag": {"delay": 0.12}})
    ((found, residual),) = segmented(late, 70001)
    assert "come late" in found.remarks[0] or "filtered" in found.remarks[0]
    assert np.median(np.abs(residual)) < 0.012
    ((found, residual),) = segmented(replace(late, effects={}), 70001)
    assert found.remarks == () and np.median(np.abs(residual)) < 0.004


def test_pads_under_filtered_forces_are_read_off_whole_grips():
    filtered = World("", effects={"force_lowpass": {"time_constant": 0.03}})
    for found, residual in segmented(filtered, 78206, 78207):
        # Stretches of forces that are late made the pads twice as soft, and releases 30 ms late.
        assert np.abs(residual).max() < 0.015 and "filtered" in found.remarks[0]


def test_reading_again_undoes_what_was_found_and_smears_no_jump():
    t = np.arange(0, 1, 0.01)
    ramp = np.clip(t - 0.3, 0, 0.4)
    late = np.interp(t - 0.05, t, ramp)
    signals = signals_of(t, 0.01, x1=late, fx1=late, fx2=late)
    pad = Compliance(2.5e-4, 1e-6, 0.05)
    again = read_again(signals, Sensing(pad, pad, 0.05, 0.001, late=True))
    np.testing.assert_allclose(again.fx1[:94], ramp[:94], atol=1e-12)
    np.testing.assert_allclose(again.x1, late)
    t = np.arange(20) * 0.05
    jump = np.where(t < 0.5, 0.0, 1.0)
    for late in (0.01, 0.02, 0.03, 0.04):
        again = resampled(t + late, t, jump)
        assert set(again[:-1]) == {0.0, 1.0}
        assert abs(t[np.argmax(again > 0.5)] - (0.5 - late)) <= 0.5 * 0.05 + 1e-9
    smooth = np.sin(2 * t)
    np.testing.assert_allclose(resampled(t + 0.02, t, smooth)[:-1], np.sin(2 * (t + 0.02))[:-1], atol=6e-3)


def test_friction_is_the_steepest_ratio_that_a_contact_shows_for_sure():
    t = np.arange(40) * 0.02
    grip = np.clip(4.0 - t / 0.2, 0.0, None)
    shear = np.minimum(1.2, 0.8 * grip)  # slides from 1.5 N on
    signals = signals_of(t, 0.01, fx1=grip, fy1=-shear, fx2=-grip, fy2=0.5 * shear)
    parameters = Parameters(np.zeros(4), {"a": 1.0}, {"force": 0.01})
    one, two = steepest(signals, 0.0, 0.8, parameters)
    assert one == pytest.approx(0.8, abs=0.06) and one < 0.8 and two == pytest.approx(0.4, abs=0.06)
    assert steepest(signals, 0.9, 1.0, parameters) == []


COMPLIANCE, WIDTH = 2.5e-4, 0.03


def whole_grip(delay=0.0, constant=0.0, step=0.02, seed=0, compliance=COMPLIANCE):
    rng, fine = np.random.default_rng(seed), np.arange(0, 2.0, 1e-4)
    start = rng.uniform(0.3, 0.32)
    closed = np.clip((fine - start) / 0.25, 0, 1) - np.clip((fine - start - 0.9) / 0.25, 0, 1)
    way = closed**2 * (3 - 2 * closed)
    distance = WIDTH + 0.006 - (0.006 + 4.5 * compliance) * way
    load = np.maximum(WIDTH - distance, 0) / compliance
    if constant:
        kept = np.exp(-1e-4 / constant)
        load = lfilter([1 - kept], [1, -kept], load)
    t = np.arange(0, 1.95, step)
    read = np.interp(t - delay, fine, load) + 0.017 * rng.standard_normal(t.size)
    seen = np.interp(t, fine, distance) + 2.8e-5 * rng.standard_normal(t.size)
    rate = np.interp(t, fine, np.gradient(distance, 1e-4)) + 4e-3 * rng.standard_normal(t.size)
    return Squeeze(t, seen, rate, read, 2.8e-5, 0.017)


@pytest.mark.parametrize(("delay", "constant", "step"), [
    *((delay, 0.0, step) for delay in (0.03, 0.06, 0.2) for step in (0.02, 0.05)), (0.0, 0.03, 0.02),
    (0.0, 0.06, 0.02)])  # fmt: skip
def test_a_delay_or_a_filter_is_found_and_they_are_distinguished(delay, constant, step):
    found = lateness([whole_grip(delay, constant, step, seed=i) for i in range(4)], PRIOR)
    assert found.late and found.filter == (constant > 0)
    assert found.delay == pytest.approx(delay + constant, abs=0.006 + 0.2 * constant * (constant > 0))
    if constant:
        value, sd = found.compliance
        assert abs(value - COMPLIANCE) < 3 * sd < 0.3 * COMPLIANCE


@pytest.mark.parametrize(("delay", "prior"), [(0.0, PRIOR), (0.0, (0.0, 2e-4)), (-0.004, PRIOR),
                                              (0.004, PRIOR)])  # fmt: skip
def test_a_small_delay_is_found_and_is_no_sensor_s(delay, prior):
    found = lateness([whole_grip(delay, seed=i) for i in range(6)], prior)
    assert not found.late and found.delay == pytest.approx(delay, abs=max(3 * found.sd, 1e-3))


def half_a_grip(step, noise, sd_load, seed):
    rng, fine = np.random.default_rng(seed), np.arange(0, 1.0, 1e-4)
    way = np.clip((fine - 0.2) / 0.35, 0, 1)
    distance = (WIDTH + 0.01 - 0.0105 * way**3 * (10 - 15 * way + 6 * way**2))[:: (-1) ** seed]
    t = np.arange(rng.uniform(0, step), 1.0, step)
    seen = np.interp(t, fine, distance) + noise * rng.standard_normal(t.size)
    load = np.interp(t, fine, np.maximum(WIDTH - distance, 0)) / COMPLIANCE
    read = load + sd_load * rng.standard_normal(t.size)
    return Squeeze(t, seen, np.gradient(seen, t), read, noise, sd_load)


@pytest.mark.parametrize("step, noise, sd_load", [(0.005, 3e-5, 0.017), (0.01, 2.8e-4, 0.14)])
def test_noise_that_joining_and_filters_average_tells_of_no_delay(step, noise, sd_load):
    """Half a sample late, or filtered, the distances' noise is smaller; nothing else speaks for it."""
    found = lateness([half_a_grip(step, noise, sd_load, 100 + i) for i in range(16)], PRIOR)
    assert not found.late and abs(found.delay) < 2 * found.sd


def test_unfiltering_undoes_a_filter_and_shows_no_touch_before_it_is_made():
    fine = np.arange(0, 1.0, 1e-4)
    force = 4 * np.clip((fine - 0.31) / 0.2, 0, 1)
    kept, t = np.exp(-1e-4 / 0.03), np.arange(0, 0.98, 0.02)
    filtered = np.interp(t, fine, lfilter([1 - kept], [1, -kept], force))
    undone, louder = _unfiltered(t, filtered, 0.03)
    np.testing.assert_allclose(undone, np.interp(t, fine, force), atol=0.15)
    assert louder == pytest.approx(np.sqrt(5)) and np.abs(undone[t < 0.31]).max() < 0.02


@pytest.mark.parametrize("step", [0.05, 0.01, 0.002])
def test_unfiltering_makes_noise_little_louder_at_any_rate(step):
    t = np.arange(0, 40, step)
    noise, louder = _unfiltered(t, np.random.default_rng(0).standard_normal(t.size), 0.03)
    assert louder < 2.24 and np.nanstd(noise) < 2.24  # 21 at 500 Hz from sample to sample


def test_heights_are_not_held_against_forces_for_being_louder():
    pad, white = Compliance(5e-4, 1e-6, 0.05), np.random.default_rng(0).standard_normal(200)
    late = Sensing(pad, pad, 0.03, 0.003, True, True, rests=2.2e-5 * white, noise=(1.5e-5, 0.01))
    loud = Sensing(pad, pad, 0.0, 0.003, rests=2.5e-5 * white, noise=(1.5e-5, 0.04))
    assert loud.heights_gain(late) > 10 and late.heights_gain(loud) < -10
    assert replace(loud, rests=5e-5 * white).heights_gain(late) < -10  # no noise explains that


SD = 2e-5


def releases(toe=NONE, number=8, compliances=(1e-4,), seed=0):
    rng, out = np.random.default_rng(seed), []
    for k in range(number):
        load = np.r_[np.full(8, 10.0), np.linspace(10, rng.uniform(0.1, 0.6), 9)]
        give = compliances[k % len(compliances)] * load + toe.give(load)
        out.append((load, rng.uniform(0.02, 0.05) - give + SD * rng.standard_normal(load.size), SD))
    return out


@pytest.mark.parametrize("planted", [Toe(6e-4, 0.8), Toe(3e-4, 1.6)])
def test_a_planted_toe_is_found(planted):
    found, at = find_toe(releases(planted)), np.array([0.0, 0.2, 1.0, 4.0])
    np.testing.assert_allclose(found.give(at), planted.give(at), atol=6e-5)
    assert found.slope == pytest.approx(planted.slope, rel=0.3)


@pytest.mark.parametrize("compliances", [(1e-4,), (1e-4, 2e-4)])
def test_straight_contacts_have_none_however_they_differ(compliances):
    assert all(find_toe(releases(compliances=compliances, seed=seed)) is NONE for seed in range(10))
