"""A pushed cube: the authors' simulation is met, a cube goes where it is pushed, engines are put beside."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from experiments.real import collins_cube, collins_hand, collins_push
from experiments.real.collins_arm import HAND, SHOWN, arm, product
from experiments.real.collins_cube import CUBE, Cube
from experiments.real.collins_engines import beside
from simgap.simulators.recording import Recording


def test_the_authors_simulation_is_met_before_the_hand_touches(shared):
    """Their engine's own recording of the hand, from the second target until the cube is near."""
    theirs = pd.read_csv(shared / "real/collins/cubepush/sim/Mujoco.csv")
    nominal = tuple(p["nominal"] for p in collins_hand.Hand.parameters.values())
    place, _ = collins_hand._course(nominal)
    mine = theirs[(theirs.t >= 8.0) & (theirs.t < 11.0)]
    times = np.arange(len(place)) * SHOWN
    for k, axis in enumerate("xyz"):
        got = np.interp(mine.t, times, place[:, k])
        np.testing.assert_allclose(got, mine[f"ee_{axis}"], atol=3e-4)


def made(speed: float) -> tuple[Cube, Recording]:
    """A hand whose bar goes 0.2 m along x at a speed [m/s] through where a cube lies, 0.05 m before it."""
    t = np.arange(0.0, 3.0, 0.02)
    mujoco, model = arm()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    across = np.array([np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)])  # the bar along y
    turn = product(across, data.xquat[model.body(HAND).id])
    up = {n: p["nominal"] for n, p in Cube.parameters.items()}
    bar = collins_cube.fingertips() + np.array([0.0, up["finger.up"], -up["finger.along"]])
    off = collins_cube.rotated(turn[:, None], bar)[:, 0]
    x = 0.4 + np.clip(speed * (t - 0.5), 0.0, 0.2)
    place = np.array([x, 0 * x, 0 * x + 0.045]) - off[:, None]
    put = dict.fromkeys(CUBE.values(), 0.0) | {"cube_x": 0.5, "cube_qw": 1.0}
    log = Recording("made", t, {n: np.full(t.size, v) for n, v in put.items()})
    return Cube({"made": (t, np.concatenate([place, np.repeat(turn[:, None], t.size, 1)]))}), log


def test_a_cube_goes_where_it_is_pushed():
    """Slowly, its near side ends at the bar's; it stays upright at usual frictions."""
    simulator, log = made(0.1)
    nominal = {n: p["nominal"] for n, p in Cube.parameters.items()}
    out = simulator.simulate(nominal, log)
    reached = 0.6 + collins_cube.RADIUS + collins_cube.SIDE / 2
    assert out["cube_x"][-1] == pytest.approx(reached, abs=3e-3)
    assert abs(out["cube_y"]).max() < 2e-3 and abs(out["cube_qy"]).max() < 0.02


def test_ends_count_from_where_a_cube_was_put():
    pose = np.zeros((2, 7, 5))
    pose[:, 3] = 1.0
    pose[:, 0] = [[0.5, 0.5, 0.55, 0.6, 0.6], [0.5, 0.5, 0.56, 0.61, 0.61]]
    told = collins_push.ends({"recorded": pose, "before": pose - 0.0, "after": pose})
    assert told["recorded"]["moved_mm"][1][0] == pytest.approx(110.0)
    assert told["after"]["rms_mm"] == [0.0, 0.0, 0.0] and told["after"]["along_with_recorded"] == 1.0


def test_engines_that_hold_the_arm_are_nearer_and_none_moves_the_cube_right(shared):
    told = beside(shared / "real/collins")
    real = told["scatter of real"]
    assert real["cube_turned_deg"] < 2 and real["rms_mm"]["reach"]["ee_z"] < 3
    for name in ("PyBullet", "VRepVortex"):
        assert told[name]["rms_mm"]["reach"]["ee_z"] < 0.25 * told["Mujoco"]["rms_mm"]["reach"]["ee_z"]
        assert abs(told[name]["cube_end_mm"][0]) < 1
    assert told["Mujoco"]["cube_turned_deg"] == pytest.approx(90.0, abs=1.0)
