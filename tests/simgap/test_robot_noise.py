"""The noise of channels, learned from differences."""

import numpy as np
import pytest

from simgap.robots.rows import learned
from simgap.simulators.recording import Recording


@pytest.mark.parametrize("course", [lambda t: 0 * t, lambda t: -4.9 * t**2, lambda t: np.sin(3 * t)])
def test_motion_is_no_noise(course):
    """A fall's second difference at 150 Hz is 0.4 mm, twenty times this noise."""
    t, rng = np.arange(3000) / 150, np.random.default_rng(0)
    log = Recording("log.csv", t, {"z": course(t) + 2e-5 * rng.standard_normal(t.size)})
    assert learned([log], "z") == pytest.approx(2e-5, rel=0.1)


def test_a_log_too_short_for_a_difference_tells_none():
    log = Recording("log.csv", np.arange(3) / 150, {"z": np.array([0.0, 1e-3, 0.0])})
    assert learned([log], "z") == pytest.approx(1.4826 * 2e-3 / np.sqrt(6))
    assert learned([log.window(0, 2)], "z") == 1.0
