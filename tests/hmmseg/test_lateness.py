"""Late and filtered forces: planted ones are found and told apart, and none are invented."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hmmseg.segmentation.pads import LATE, Squeeze, _unfiltered, lateness

COMPLIANCE, WIDTH = 2.5e-4, 0.03
PRIOR = (COMPLIANCE, 0.3 * COMPLIANCE)


def squeeze(delay=0.0, constant=0.0, step=0.02, seed=0, compliance=COMPLIANCE):
    """Fingers that close on a block, hold it and open, their forces late by `delay` or filtered."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0, 2.0, 1e-4)
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


@pytest.mark.parametrize("step", [0.02, 0.05])
@pytest.mark.parametrize("delay", [0.03, 0.06, 0.2])
def test_a_delay_is_found(delay, step):
    found = lateness([squeeze(delay, step=step, seed=i) for i in range(4)], PRIOR, LATE)
    assert found is not None and not found.filter and found.gain > 15
    assert found.delay == pytest.approx(delay, abs=0.006)


@pytest.mark.parametrize("constant", [0.03, 0.06])
def test_a_filter_is_found_and_told_from_a_delay(constant):
    found = lateness([squeeze(constant=constant, seed=i) for i in range(4)], PRIOR, LATE)
    assert found is not None and found.filter and found.gain > 15
    assert found.delay == pytest.approx(constant, rel=0.2)


def test_pads_softer_than_stated_are_no_delay():
    own = [squeeze(seed=i, compliance=1.6 * COMPLIANCE) for i in range(4)]
    found = lateness(own, PRIOR, LATE)
    assert found is not None and (found.gain < 1 or found.delay < LATE)


@pytest.mark.parametrize("prior", [PRIOR, (0.0, 2e-4)])
def test_forces_on_time_are_not_late(prior):
    found = lateness([squeeze(seed=i) for i in range(4)], prior, LATE)
    assert found is not None and (found.gain < 1 or found.delay < LATE)


def test_nothing_tells_nothing():
    assert lateness([], PRIOR, LATE) is None


def test_unfiltering_undoes_a_filter_and_shows_no_touch_before_it_is_made():
    fine = np.arange(0, 1.0, 1e-4)
    force = 4 * np.clip((fine - 0.31) / 0.2, 0, 1)
    kept = np.exp(-1e-4 / 0.03)
    t = np.arange(0, 0.98, 0.02)
    filtered = np.interp(t, fine, lfilter([1 - kept], [1, -kept], force))
    undone, louder = _unfiltered(t, filtered, 0.03)
    np.testing.assert_allclose(undone, np.interp(t, fine, force), atol=0.15)
    assert louder == pytest.approx(np.sqrt(1 + np.exp(-4 / 3)) / (1 - np.exp(-2 / 3)), rel=1e-6)
    assert np.abs(undone[t < 0.31]).max() < 0.02
