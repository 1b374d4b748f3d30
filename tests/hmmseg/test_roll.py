"""Hands that roll: against planted angles, in every stage that reads a recording."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rolling_scene import rolling_trial

import estimation.identification
import hmmseg.segmentation.posteriors
from estimation import identify
from experiments.scoring import boundaries_covered, boundary_residuals
from experiments.worlds import WORLDS, scene, trials_of
from hmmseg.contact.decompose import subtasks
from hmmseg.contact.equations import corner_drop, pads_of, rolled_offset, turned
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.hand.roll import levelled, slow_roll
from hmmseg.hand.signals import task_space
from hmmseg.io.trial import CARTESIAN_CHANNELS, ROLL
from hmmseg.online.watcher import Watcher
from hmmseg.segmentation.align import segment
from hmmseg.segmentation.posteriors import tilts
from simgap.world.properties import random_properties

NUMBERS = range(76100, 76106)


def _without_column(trial):
    return replace(trial, channels={k: v for k, v in trial.channels.items() if k != ROLL})


def test_equations_of_a_rolled_block():
    corners = np.array([[-0.03, 0.0], [0.03, 0.0]])
    x, y = turned(*corners.T, 0.02)
    assert y.min() == pytest.approx(-corner_drop(0.06, 0.02), rel=1e-4)
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


def test_noise_is_no_roll_and_a_roll_is_found():
    t, rng = np.arange(100) / 50, np.random.default_rng(1)
    noise, distance = 3e-5 * rng.standard_normal(100), np.full(100, 0.05)
    planted = 0.02 * np.sin(2 * t)
    none, _ = slow_roll(t, noise, distance)
    found, sd = slow_roll(t, noise + rolled_offset(distance, planted), distance)
    assert np.sqrt(np.mean(none**2)) < 2e-4
    assert np.sqrt(np.mean((found - planted) ** 2)) < 2 * sd < 1e-3


def test_a_landing_on_a_corner_is_dated_as_a_level_one(monkeypatch):
    """Blocks rolled by 40 mrad touch their place with a corner: by their middle's height that is late."""
    task = scene()[1]

    def landings(angle: float, column: bool) -> tuple[np.ndarray, float]:
        found, held = [], []
        for number in NUMBERS:
            trial, rig, true = rolling_trial(number, angle)
            (one,) = segment([levelled(trial) if column else _without_column(trial)], task, rig)
            found.append(boundary_residuals(one, true)[2::4])
            held.append(boundaries_covered(one, true))
        return np.concatenate(found), float(np.mean(held))

    level, _ = landings(0.0, True)
    (recorded, held), (inferred, also) = landings(0.04, True), landings(0.04, False)
    flat = lambda s, *_: (np.zeros(s.t.size), 0.0)  # noqa: E731
    monkeypatch.setattr(hmmseg.segmentation.posteriors, "corner_drops", flat)
    ignored, _ = landings(0.04, False)
    assert (ignored - level).mean() > 1e-3
    for found in (recorded, inferred):
        assert abs((found - level).mean()) < 0.5 * (ignored - level).mean()
        assert np.abs(found - level).mean() < 0.8 * np.abs(ignored - level).mean()
    assert min(held, also) >= 0.86


def test_a_width_along_the_hand(monkeypatch):
    """A block held by a hand that rolls by 50 mrad looks narrower by a thousandth, if it were not told."""
    trial, rig, _ = rolling_trial(76200, 0.05)
    task, blocks = scene()[1], random_properties(scene()[1], 76200)

    def error() -> float:
        found = identify(_without_column(trial), task, rig)
        return float(np.mean([found.of(o, "width").mean() / blocks[o].width - 1 for o in task.objects]))

    turned_back = error()
    monkeypatch.setattr(estimation.identification, "without_roll", lambda aligned: aligned)
    as_it_is = error()
    lost = np.mean(1 - np.cos(trial.channels[ROLL][trial.channels[ROLL] != 0]))
    assert as_it_is - turned_back < -0.3 * lost
    assert abs(turned_back) < 1e-3


def test_a_watcher_takes_the_roll_out_row_by_row():
    trial, rig, _ = rolling_trial(76200, 0.05)
    rolled, level = Watcher(scene()[1], rig), Watcher(scene()[1], rig)
    names, flat = (*CARTESIAN_CHANNELS, ROLL), levelled(trial)
    for k, t in enumerate(trial.t[:200]):
        rolled.update(t, [trial.channels[n][k] for n in names])
        level.update(t, [flat.channels[n][k] for n in CARTESIAN_CHANNELS])
    for (_, a), (_, b) in zip(rolled.filter.rows, level.filter.rows, strict=True):
        np.testing.assert_allclose(a[[0, 1, 4, 5, 6, 7, 10, 11]], b[[0, 1, 4, 5, 6, 7, 10, 11]], atol=1e-12)


def test_fingers_with_joints_of_their_own_do_not_roll():
    """Their heights differ by a block that slips along one of them; landings had come 6 ms early."""
    (judged,) = trials_of(WORLDS["slipping"], [77001])
    steps, s = subtasks(scene()[1]), task_space(judged.trial, judged.rig)
    edges = [float(s.t[0]), *judged.boundaries, float(s.t[-1])]
    assert not list(tilts(s, pads_of(judged.rig), list(pairwise(edges)), steps))
    assert list(tilts(replace(s, coupled=True), pads_of(judged.rig), list(pairwise(edges)), steps))
