"""What a frame leaves out or doubts, and the blocks of simulated recordings."""

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.hand.signals import task_space
from hmmseg.segmentation.align import align
from simgap.gap import simulated
from simgap.gap.frame import CHANNELS, build, thinned, without_dropouts
from simgap.gap.search import search
from simgap.gap.sensor_noise import sensor_sd
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block
from simgap.world.simulate import SimulatedTrial, simulate_trials

BLOCKS = {name: Block(0.5, 0.02 + 0.004 * k, 0.018, 0.7) for k, name in enumerate(TASK.objects)}
FORCES = ("fx1", "fy1", "fx2", "fy2")


def test_blocks_are_those_that_were_recorded_whatever_was_measured():
    alone = simulated.blocks_of(search(align(TRIALS, TASK, RIG)))
    wrong = {"block1": {"height": (alone["block1"].height + 2e-3, 1e-4)}}
    told = simulated.blocks_of(search(align(TRIALS, TASK, RIG), wrong))
    assert told["block1"].height == pytest.approx(alone["block1"].height, abs=2e-4)
    assert told["block2"].width == pytest.approx(alone["block2"].width, abs=1e-4)
    assert simulated.measured_on(told, wrong) == {"block1": {"height": (told["block1"].height, 1e-4)}}
    assert simulated.measured_on(told, None) is None


@pytest.fixture(scope="module")
def quick() -> SimulatedTrial:
    """A hasty operator at 500 Hz."""
    rig = RIG.model_copy(update={"rate": 500.0})
    return simulate_trials(TASK, rig, [BLOCKS], [41], OperatorSettings(pace=(1.8, 1.8)))[0]


def test_a_reading_that_one_finger_lost_is_left_out(quick):
    touch, leave = quick.boundaries[:2]
    inside = np.flatnonzero((quick.trial.t > touch + 0.1) & (quick.trial.t < leave))[::9]
    channels = {k: v.copy() for k, v in quick.trial.channels.items()}
    for c in ("fx2", "fy2"):
        channels[c][inside] = 0.002
    left = without_dropouts(replace(quick.trial, channels=channels))
    for c in FORCES:
        assert (np.flatnonzero(np.isnan(left.channels[c])) == inside).all()
    assert without_dropouts(quick.trial) is quick.trial  # no touch and no release is taken for one


def test_what_pads_damp_is_in_doubt_and_quick_fingers_are_where_their_mean_is(quick):
    rig = RIG.model_copy(update={"rate": 500.0})
    frame = build(align([quick.trial], TASK, rig))
    n, column, arrays = frame.lengths[0], CHANNELS.index("distance"), frame.arrays
    phase = frame.world.ground[0, :n] + frame.world.carry[0, :n]
    there = (arrays.there[0, :n, column] > 0) & (phase > 0)
    signals = task_space(thinned(quick.trial, rig)[0], rig)
    width = signals.distance + (signals.fx1 - signals.fx2) / rig.fingertip.normal_stiffness
    own = np.array([BLOCKS[m.object].width for m in TASK.performed])[arrays.onehot[0, :n].argmax(axis=1)]
    off = (width - own)[there]
    plain, doubted = (sd[0, :n, column][there] for sd in (arrays.plain, arrays.sd))
    assert (doubted / plain).max() > 2  # as fingers close
    assert np.abs(off / doubted).max() < 3.5


def test_means_of_speeds_that_a_drive_makes_of_angles_are_quieter_than_one():
    rng, group, rate = np.random.default_rng(0), 17, 500.0
    angles = 2e-4 * rng.standard_normal((200 * group + 1, 4))
    rates = (np.diff(angles, axis=0) * rate).reshape(200, group, 4).mean(1)
    joints = angles[1:].reshape(200, group, 4).mean(1)
    stated = 2e-4 * rate * np.sqrt(2)
    rig = RIG.model_copy(update={"noise": RIG.noise.model_copy(update={"velocity": stated})})
    nothing = dict.fromkeys(("x", "vx", "force"), np.full(200, 0.01))
    sd = sensor_sd(joints, rates, nothing, rig, group)
    assert sd[:, 1] == pytest.approx(rates.std(), rel=0.35)  # successive means are not independent
    assert (sd[:, 1] < 0.4 * stated / np.sqrt(group)).all()
