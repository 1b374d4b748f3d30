"""Hands that roll: against planted angles, in every stage that reads a recording."""

from dataclasses import replace

import numpy as np
import pytest
from rolling_scene import rolling_trial

from experiments.worlds import scene
from hmmseg.contact.equations import rolled_offset, turned
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.hand.roll import levelled
from hmmseg.io.trial import CARTESIAN_CHANNELS, ROLL
from hmmseg.online.watcher import Watcher

NUMBERS = range(76100, 76106)


def _without_column(trial):
    return replace(trial, channels={k: v for k, v in trial.channels.items() if k != ROLL})


def test_equations_of_a_rolled_block():
    corners = np.array([[-0.03, 0.0], [0.03, 0.0]])
    x, y = turned(*corners.T, 0.02)
    assert y[1] - y[0] == pytest.approx(rolled_offset(0.06, 0.02), rel=1e-4)
    assert np.hypot(x, y) == pytest.approx([0.03, 0.03])


def test_a_recorded_roll_is_taken_out():
    rolled, _, _ = rolling_trial(76200, 0.05)
    level, _, _ = rolling_trial(76200, 0.0)
    found = levelled(rolled)
    for name in ("x1", "x2", "fx1", "fy1", "fx2", "fy2"):
        np.testing.assert_allclose(found.channels[name], level.channels[name], atol=1e-9)
    # The hand is higher by what the corner hangs lower; what the fingers differ by is as it was.
    for name in ("y", "vy"):
        apart, before = (c[f"{name}2"] - c[f"{name}1"] for c in (found.channels, level.channels))
        np.testing.assert_allclose(apart, before, atol=1e-9 if name == "y" else 2e-3)


def test_no_hand_rolls_so_far(tmp_path):
    trial, rig, _ = rolling_trial(76200, 0.02)
    degrees = replace(trial, channels=trial.channels | {ROLL: np.degrees(trial.channels[ROLL])})
    with pytest.raises(InputError, match=r"column hand_roll: .* rad; expected radians, .* in degrees"):
        levelled(degrees)
    table = {"t": trial.t} | degrees.channels
    with pytest.raises(InputError, match="column hand_roll"):
        read_trial(table, rig)
    read = read_trial({"t": trial.t} | trial.channels, rig)
    np.testing.assert_allclose(read.channels["fy1"], levelled(trial).channels["fy1"])


def test_a_watcher_takes_the_roll_out_row_by_row():
    trial, rig, _ = rolling_trial(76200, 0.05)
    rolled, level = Watcher(scene()[1], rig), Watcher(scene()[1], rig)
    names, flat = (*CARTESIAN_CHANNELS, ROLL), levelled(trial)
    for k, t in enumerate(trial.t[:200]):
        rolled.update(t, [trial.channels[n][k] for n in names])
        level.update(t, [flat.channels[n][k] for n in CARTESIAN_CHANNELS])
    for (_, a), (_, b) in zip(rolled.filter.rows, level.filter.rows, strict=True):
        np.testing.assert_allclose(a[[0, 1, 4, 5, 6, 7, 10, 11]], b[[0, 1, 4, 5, 6, 7, 10, 11]], atol=1e-12)
