"""Healthy twins of logs that a simulator cannot be run along, and how their noise grows."""

from __future__ import annotations

import numpy as np
from simgap_swing import Swing, log

from simgap.robots.linear import linearise
from simgap.robots.model import Composed
from simgap.robots.twins import along_logs, along_windows, healthy_twins
from simgap.simulators.user import checked


class Upright(Swing):
    """Gravity upwards: what is driven by torques along a whole log falls away from it."""

    parameters = Swing.parameters | {
        "gravity_torque": {"nominal": -0.5, "sd": 0.05, "unit": "N m", "low": -1.0}
    }


def composed(simulator, logs) -> Composed:
    return Composed.of(checked(simulator, "here"), logs, {}, {"angle": 5e-4})


def test_twins_stay_by_the_recorded_motion_where_a_run_of_the_log_would_not():
    """The model's gravity is the wrong way: windows still begin where the recording is."""
    made = composed(Upright(), [log(0, seconds=4.0)])
    plain = linearise(made, {}, [])
    twin = along_windows(made, {}, {"angle": 0.0}, np.random.default_rng(0))
    for mine, theirs in zip(made.windows, twin.windows, strict=True):
        assert abs(mine.start["angle"] - theirs.start["angle"]) < 0.2
    far = along_logs(made, {}, {"angle": 0.0}, np.random.default_rng(0))
    pairs = zip(made.windows, far.windows, strict=True)
    assert max(abs(a.start["angle"] - b.start["angle"]) for a, b in pairs) > 2
    assert np.nanmax(np.abs(linearise(twin, {}, []).residual)) < 0.1
    found = healthy_twins(made, plain, 0)
    assert np.median(found.factor) < 1.2
    white = np.array(found.residuals)
    assert 0.8 < np.mean(white**2) < 1.2


def test_a_start_that_is_read_badly_makes_its_own_window_uncertain():
    """A knock in the middle of a log, which a parabola through its neighbours does not follow."""
    knocked = log(0, seconds=4.0)
    torque = knocked["torque"].copy()
    torque[:4] += 60.0
    robot = Swing()
    values = {n: p["nominal"] for n, p in robot.parameters.items()}
    driven = knocked.with_columns({"torque": torque})
    angle = robot.simulate(values, driven)["angle"]
    made = composed(Swing(), [driven.with_columns({"angle": angle})])
    factor = healthy_twins(made, linearise(made, {}, []), 0).factor
    window = made.rows.window
    assert factor[window == 0].max() > 1.5 and np.median(factor[window > 0]) < 1.2
