"""What is seen once is no effect; a single in a worse optimum is freed from it by its pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from simgap.gap.affected import shifts
from simgap.gap.candidate import Candidate, recurring
from simgap.gap.diagnose import diagnose
from simgap.gap.fit import Start, fit, slots
from simgap.gap.frame import CHANNELS
from simgap.gap.pairs import unstuck


@pytest.fixture(scope="module")
def quiet():
    return diagnose(TRIALS, TASK, RIG)


def _slip(quiet, gain):
    """A slip whose squares are less than the healthy ones by twice `gain` (T, S)."""
    f = replace(quiet.healthy, effects=("grip_slip",), square=quiet.healthy.square - 2 * gain)
    return Candidate("grip_slip", 20.0, f)


def test_what_one_subtask_of_one_trial_gains_is_no_slip(quiet):
    gain = np.zeros(quiet.healthy.square.shape)
    gain[1, 3] = 30.0
    assert recurring(quiet.problem, _slip(quiet, gain), quiet.healthy, 1.5).evidence == pytest.approx(0.0)
    gain[:, 3] = 30.0
    assert recurring(quiet.problem, _slip(quiet, gain), quiet.healthy, 1.5).evidence == 20.0


def test_what_one_block_shows_in_one_subtask_alone_is_no_effect_of_the_hand(quiet):
    gain = np.zeros(quiet.healthy.square.shape)
    gain[1:3, 1] = 30.0

    def found():
        slip = _slip(quiet, gain)
        return replace(slip, name="force_bias", fitted=replace(slip.fitted, effects=("force_bias",)))

    assert recurring(quiet.problem, found(), quiet.healthy, 1.5).evidence == pytest.approx(20.0 - 60.0 / 1.5)
    gain[:, 1] = (20.0, 30.0, 10.0, 15.0)  # with one block, but in every trial
    assert recurring(quiet.problem, found(), quiet.healthy, 1.5).evidence == 20.0
    gain[:, 1] = (0.0, 30.0, 30.0, 0.0)
    gain[0, 5] = 20.0  # in one trial, but with the other block as well
    assert recurring(quiet.problem, found(), quiet.healthy, 1.5).evidence == 20.0
    gain[:, 1] = 900.0  # a displaced boundary outweighs what else there is
    assert recurring(quiet.problem, found(), quiet.healthy, 1.5).evidence == 20.0


def test_a_single_in_a_worse_optimum_is_freed_by_its_pair(quiet):
    given, healthy = quiet.problem, quiet.healthy
    single = Candidate("force_bias", -5.0, fit(given, [Start(("force_bias",), healthy.u)])[0])
    stuck = replace(single, evidence=-50.0, fitted=replace(single.fitted, cost=single.fitted.cost + 40.0))
    both = fit(given, [Start(("force_bias", "force_gain"), healthy.u)])[0]
    pair = Candidate("force_bias+force_gain", 10.0, both)
    (freed,) = unstuck(given, [stuck], [pair], healthy, 1.5)
    assert freed.fitted.cost == pytest.approx(single.fitted.cost, abs=0.5) and freed.evidence > stuck.evidence
    (same,) = unstuck(given, [single], [pair], healthy, 1.5)
    assert same is single


def test_a_tilt_shifts_heights_away_from_where_the_stack_stood(quiet):
    found = diagnose(TRIALS, TASK, RIG, forced=["table_tilt"])
    (tilt,) = found.candidates
    slot = next(s for s in slots(found.problem.num_properties)[0] if s.effect.name == "table_tilt")
    u = tilt.fitted.u.copy()
    u[slot.start] = slot.effect.parameters[0].coordinate(0.02)
    mean = shifts(found.problem, replace(tilt, fitted=replace(tilt.fitted, u=u)))
    heights, steps = mean[0, :, CHANNELS.index("y")], [s.name for s in found.problem.frame.steps]
    assert heights[steps.index("pickup")] < 1.0 and heights[steps.index("place")] > 3.0
    others = [c for c in range(len(CHANNELS)) if CHANNELS[c] != "y"]
    assert np.abs(mean[0][:, others]).max() < 1e-6
