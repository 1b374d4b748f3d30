"""Task space of a hand: kinematics and noise, against numerical derivatives and samples."""

import numpy as np
import pandas as pd
import pytest

from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import parse_rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS

FINGERS = {
    "1": {"base": [0.05, 0.17], "links": [0.12, 0.11]},
    "2": {"base": [0.21, 0.17], "links": [0.1, 0.12]},
}
JOINTED = parse_rig({"fingers": FINGERS, "noise": {"angle": 2e-4, "velocity": 0.03, "force": 0.012}})
CARTESIAN = parse_rig({"noise": {"position": 1e-4, "velocity": 0.01, "force": 0.02}})


def cartesian(samples=12) -> pd.DataFrame:
    values = np.random.default_rng(0).normal(scale=0.1, size=(samples, len(CARTESIAN_CHANNELS)))
    return pd.DataFrame(
        {"t": np.arange(samples) * 0.05} | dict(zip(CARTESIAN_CHANNELS, values.T, strict=True))
    )


def test_noise_of_a_position_agrees_with_samples():
    rng, n = np.random.default_rng(1), 20_000
    frame = pd.DataFrame({"t": np.arange(n) * 1e-3, **{name: 0.0 for name in JOINT_CHANNELS}})
    for name, angle in (("q11", -2.0), ("q12", -0.1), ("q21", -1.1), ("q22", -3.0)):
        frame[name] = angle + rng.normal(scale=2e-4, size=n)
        frame[f"d{name}"] = rng.normal(scale=0.03, size=n)
    signals = task_space(read_trial(frame, JOINTED), JOINTED)
    for axis in ("x", "y", "vx", "vy"):
        both = np.concatenate([getattr(signals, f"{axis}1"), getattr(signals, f"{axis}2")]).reshape(2, -1)
        rms = np.sqrt(both.var(axis=1).mean())  # `sd_*` is the fingers' root mean square
        assert getattr(signals, f"sd_{axis}").mean() == pytest.approx(rms, rel=0.03)
    assert signals.sd_force == 0.012


def test_cartesian_velocities_given_or_derived():
    frame = cartesian(200)
    given = task_space(read_trial(frame, CARTESIAN), CARTESIAN)
    np.testing.assert_array_equal(given.vx1, frame["vx1"])
    assert given.sd_vx == pytest.approx(np.full(200, 0.01))
    t = frame["t"].to_numpy()
    frame["x1"], frame["x2"] = t**2 / 100, t**2 / 100 + 0.1
    frame.loc[7, "x1"] = np.nan
    derived = task_space(
        read_trial(frame.drop(columns=["vx1", "vy2"]).assign(vx2=np.nan), CARTESIAN), CARTESIAN
    )
    assert np.isnan(derived.vx1[7])
    np.testing.assert_allclose(np.delete(derived.vx1, 7)[1:-1], np.delete(t, 7)[1:-1] / 50, atol=1e-12)
    np.testing.assert_allclose(derived.vx2[1:-1], t[1:-1] / 50, atol=1e-12)
    np.testing.assert_array_equal(derived.vy1, frame["vy1"])


def test_noise_of_a_derived_velocity_agrees_with_samples():
    rng, n = np.random.default_rng(2), 20_000
    frame = pd.DataFrame(
        {"t": np.arange(n) * 0.01, **{name: 0.0 for name in CARTESIAN_CHANNELS if "v" not in name}}
    )
    for name in ("x1", "y1", "x2", "y2"):
        frame[name] = rng.normal(scale=1e-4, size=n)
    signals = task_space(read_trial(frame, CARTESIAN), CARTESIAN)
    assert signals.sd_vx[5] == pytest.approx(signals.vx1.std(), rel=0.03)
    assert signals.sd_vy[0] == pytest.approx(2 * signals.sd_vy[5])


def test_task_space_of_a_grip():
    frame = cartesian()
    frame = frame.assign(fx1=2.0, fx2=-1.5, fy1=0.3, fy2=0.1, x1=0.1, x2=0.13, y1=0.02, y2=0.05)
    signals = task_space(read_trial(frame, CARTESIAN), CARTESIAN)
    found = {
        name: getattr(signals, name)[0]
        for name in ("grip", "fx", "fy", "shear", "distance", "offset", "x", "y")
    }
    assert found == pytest.approx({"grip": 1.5, "fx": 0.5, "fy": 0.4, "shear": 0.1, "distance": 0.03,
                                   "offset": 0.03, "x": 0.115, "y": 0.035})  # fmt: skip
