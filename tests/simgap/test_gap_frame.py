"""What a frame leaves out or doubts: lost readings, pads that close or let go, blocks at a lift."""

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg.segmentation.align import AlignedTrials, align
from hmmseg.segmentation.boundaries import BoundaryPosterior
from simgap.gap import simulated
from simgap.gap.frame import CHANNELS, build, thinned, without_dropouts
from simgap.gap.residuals import HELD, LOOSE, firmness
from simgap.gap.search import search
from simgap.gap.sensor_noise import STARTING, UNSEEN, between_samples, channel_noise, sample_noise, sensor_sd
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block
from simgap.world.simulate import SimulatedTrial, simulate_trials

BLOCKS = {name: Block(0.5, 0.02 + 0.004 * k, 0.018, 0.7) for k, name in enumerate(TASK.objects)}
FORCES = ("fx1", "fy1", "fx2", "fy2")
DEMO = example_folder()
MOVES = np.repeat(np.eye(2)[None, [0] * 10 + [1] * 10], 1, axis=0)  # (1, 20, 2)


def test_blocks_are_those_that_were_recorded_and_lost_readings_are_left_out(quick):
    alone = simulated.blocks_of(search(align(TRIALS, TASK, RIG)))
    wrong = {"block1": {"height": (alone["block1"].height + 2e-3, 1e-4)}}
    told = simulated.blocks_of(search(align(TRIALS, TASK, RIG), wrong))
    assert told["block1"].height == pytest.approx(alone["block1"].height, abs=2e-4)
    assert told["block2"].width == pytest.approx(alone["block2"].width, abs=1e-4)
    assert simulated.measured_on(told, wrong) == {"block1": {"height": (told["block1"].height, 1e-4)}}
    assert simulated.measured_on(told, None) is None
    touch, leave = quick.boundaries[:2]
    inside = np.flatnonzero((quick.trial.t > touch + 0.1) & (quick.trial.t < leave))[::9]
    channels = {k: v.copy() for k, v in quick.trial.channels.items()}
    for c in ("fx2", "fy2"):
        channels[c][inside] = 0.002
    left = without_dropouts(replace(quick.trial, channels=channels))
    for c in FORCES:
        assert (np.flatnonzero(np.isnan(left.channels[c])) == inside).all()
    assert without_dropouts(quick.trial) is quick.trial  # no touch and no release is taken for one


@pytest.fixture(scope="module")
def quick() -> SimulatedTrial:
    rig = RIG.model_copy(update={"rate": 500.0})
    return simulate_trials(TASK, rig, [BLOCKS], [41], OperatorSettings(pace=(1.8, 1.8)))[0]


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


def test_noise_of_a_jointed_finger_is_of_its_pose_and_of_means_of_speeds_quieter():
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
    rig = read_rig(DEMO / "rig.toml")
    trial = read_trial(DEMO / "trial_01.csv", rig)
    s = task_space(trial, rig)
    one = sample_noise(s, 1)
    np.testing.assert_allclose(one["y"], s.sd_y)
    assert np.ptp(one["y"]) > 0.05 * one["y"].mean() and np.ptp(one["force"]) == 0
    np.testing.assert_allclose(sample_noise(s, 4)["y"], s.sd_y / 2)
    np.testing.assert_allclose(channel_noise(one)[:, CHANNELS.index("distance")], np.sqrt(2) * s.sd_x)


def grips(first: list[float]) -> np.ndarray:
    """Firmness (20,): one grip begins with the given ones and is 2 N, the other is 0.5 N."""
    grip = np.asarray([[*first, *[2.0] * (10 - len(first)), *[0.5] * 10]])
    return np.asarray(firmness(grip, np.ones_like(grip), np.asarray(MOVES)))[0]


@pytest.mark.parametrize(("grip", "holds"), [(0.3, False), (0.05, False), (1.6, True)])
def test_a_grip_is_firm_by_what_it_usually_is(grip, holds):
    firm = grips([grip])
    assert firm[0] > 0.95 if holds else firm[0] < 0.05
    assert firm[5] > 0.95


def test_a_grip_is_firm_where_it_is_usual_and_a_start_off_a_support_is_in_doubt():
    assert (grips([])[10:] > 0.95).all()
    grip = np.full((1, 20), 0.5 * HELD)
    assert (np.asarray(firmness(grip, np.ones_like(grip), np.asarray(MOVES))) < 0.1).all() and 0 < LOOSE < 1
    t, force = np.arange(12) * 0.05, np.zeros((12, 4))
    force[6:, 1] = 0.8  # N; the weight comes onto one finger within a sample
    free, starting = np.zeros(12, bool), t == t[6]
    doubt = between_samples(t, force, free, starting, np.array([t[6]]))
    assert doubt[6, 1] == pytest.approx(STARTING * 0.8)
    assert doubt[5, 1] == pytest.approx(UNSEEN * 0.8) and doubt[0, 1] == 0


def _lift(aligned: AlignedTrials, at: float, known_to: float) -> AlignedTrials:
    """The first trial with its first lift at `at` [s], give or take `known_to`."""
    first, *rest = aligned.trials
    k = next(k for k, s in enumerate(aligned.subtasks) if s.name == "carry") - 1
    lift = BoundaryPosterior(at + known_to * np.linspace(-1, 1, 9), np.full(9, 1 / 9))
    boundaries = tuple(lift if j == k else b for j, b in enumerate(first.boundaries))
    return replace(aligned, trials=(replace(first, boundaries=boundaries), *rest))


def test_a_sample_that_may_be_on_either_side_of_a_lift_is_of_neither():
    rig, task = read_rig(DEMO / "rig.toml"), read_task(DEMO / "task.toml")
    trials = [read_trial(DEMO / f"trial_{k:02d}.csv", rig) for k in (1, 2)]
    aligned = align(trials, task, rig)
    k = next(k for k, s in enumerate(aligned.subtasks) if s.name == "carry") - 1
    t = trials[0].t
    j = int(np.searchsorted(t, aligned.trials[0].boundaries[k].quantile(0.5)))
    columns = [CHANNELS.index(c) for c in ("y", "fy")]

    def told(at: float, known_to: float) -> np.ndarray:
        there = build(_lift(aligned, at, known_to)).arrays.there[0]
        return there[j - 2 : j + 2, columns].sum(1)

    step = t[j] - t[j - 1]
    np.testing.assert_array_equal(told(t[j] - 0.5 * step, 0.1 * step), [1, 1, 1, 1])
    np.testing.assert_array_equal(told(t[j] + 0.01 * step, 0.1 * step), [1, 1, 0, 1])
    np.testing.assert_array_equal(told(t[j] - 0.5 * step, 0.6 * step), [1, 0, 0, 1])
