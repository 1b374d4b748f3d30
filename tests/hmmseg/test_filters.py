"""Filters of our own, which save an import, against SciPy's."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter, savgol_filter

from hmmseg.hand.tool import smooth
from hmmseg.segmentation.pads import Squeeze, _joined
from hmmseg.segmentation.stretches import lagging


@pytest.mark.parametrize("deriv", [0, 1, 2])
@pytest.mark.parametrize(("size", "window"), [(40, 0.05), (200, 0.25), (7, 0.07), (9, 0.5)])
def test_local_parabolas_are_those_of_savitzky_and_golay(size, window, deriv):
    t, values = 0.01 * np.arange(size), np.random.default_rng(size).normal(size=(size, 2))
    length = min(max(3, round(window / 0.01) // 2 * 2 + 1), (size - 1) // 2 * 2 + 1)
    expected = savgol_filter(values, length, 2, deriv=deriv, delta=0.01, axis=0, mode="interp")
    np.testing.assert_allclose(smooth(t, values, deriv, window), expected, atol=1e-12 * 100.0**deriv)


def test_what_lags_behind_a_filter_is_what_the_filter_makes_of_every_step():
    rng = np.random.default_rng(1)
    values, kept = rng.normal(size=(2, 3, 50)), np.array([0.0, 0.3, 0.95])
    place, share = np.array([0, 0, 7, 20, 48]), rng.uniform(size=5)
    for c, k in enumerate(kept):
        every = lfilter([1 - k], [1, -k], values, zi=k * values[..., :1])[0]
        expected = (1 - share) * every[..., place] + share * every[..., place + 1]
        np.testing.assert_allclose(lagging(values, kept, place, share)[..., c], expected, rtol=1e-14)


def test_distances_between_samples_are_hermite_pieces():
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.01, 0.05, size=20))
    distance, rate = rng.normal(size=(2, 20))
    clock = np.linspace(t[0], t[-1], 333)
    found = _joined(Squeeze(t, distance, rate, np.zeros(20), 1e-5, 1e-2), clock)
    np.testing.assert_allclose(found, CubicHermiteSpline(t, distance, rate)(clock), atol=1e-12)
