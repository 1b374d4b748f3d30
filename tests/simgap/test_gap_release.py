"""What is seen while pads close or let go, or a block comes off its support, is no evidence of an effect."""

from dataclasses import replace

import numpy as np
import pytest

from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg.segmentation.align import AlignedTrials, align
from hmmseg.segmentation.boundaries import BoundaryPosterior
from simgap.gap.frame import CHANNELS, build
from simgap.gap.residuals import HELD, LOOSE, firmness
from simgap.gap.sensor_noise import STARTING, UNSEEN, between_samples, channel_noise, sample_noise

DEMO = example_folder()
MOVES = np.repeat(np.eye(2)[None, [0] * 10 + [1] * 10], 1, axis=0)  # (1, 20, 2)


def grips(first: list[float]) -> np.ndarray:
    """Firmness (20,): one grip begins with the given ones and is 2 N, the other is 0.5 N."""
    grip = np.asarray([[*first, *[2.0] * (10 - len(first)), *[0.5] * 10]])
    return np.asarray(firmness(grip, np.ones_like(grip), np.asarray(MOVES)))[0]


@pytest.mark.parametrize(("grip", "holds"), [(0.3, False), (0.05, False), (1.6, True)])
def test_a_grip_is_firm_by_what_it_usually_is(grip, holds):
    firm = grips([grip])
    assert firm[0] > 0.95 if holds else firm[0] < 0.05
    assert firm[5] > 0.95


def test_a_light_grip_is_firm_where_it_is_usual_and_nothing_is_held_by_less_than_noise():
    assert (grips([])[10:] > 0.95).all()
    grip = np.full((1, 20), 0.5 * HELD)
    assert (np.asarray(firmness(grip, np.ones_like(grip), np.asarray(MOVES))) < 0.1).all() and 0 < LOOSE < 1


def test_how_fast_a_block_comes_off_its_support_is_in_doubt():
    t = np.arange(12) * 0.05
    force = np.zeros((12, 4))
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


def test_noise_of_a_jointed_finger_changes_with_its_pose():
    rig = read_rig(DEMO / "rig.toml")
    trial = read_trial(DEMO / "trial_01.csv", rig)
    s = task_space(trial, rig)
    one = sample_noise(s, 1)
    np.testing.assert_allclose(one["y"], s.sd_y)
    assert np.ptp(one["y"]) > 0.05 * one["y"].mean() and np.ptp(one["force"]) == 0
    np.testing.assert_allclose(sample_noise(s, 4)["y"], s.sd_y / 2)
    np.testing.assert_allclose(channel_noise(one)[:, CHANNELS.index("distance")], np.sqrt(2) * s.sd_x)
