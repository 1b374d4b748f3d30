"""What one trial alone shows is an event; what recurs is a gap. Cells are listed with their share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.io.trial import Trial
from simgap.gap.bank import load_bank
from simgap.gap.diagnose import diagnose
from simgap.gap.judge import alien
from simgap.gap.locate import BESIDE, tamed


def pressed(trial: Trial) -> Trial:
    """A fingertip that comes down on something for 0.4 s in the free motion between the moves."""
    loud = np.abs(trial.channels["fx1"]) > 0.5  # a grip
    gaps = np.flatnonzero(np.diff(loud.astype(int)))  # first grip on, off, second on, off
    middle = trial.t[(gaps[1] + gaps[2]) // 2]
    force = trial.channels["fy2"] - 3.0 * (np.abs(trial.t - middle) < 0.2)
    return replace(trial, channels=trial.channels | {"fy2": force})


@pytest.fixture(scope="module")
def once():
    return diagnose([pressed(TRIALS[0]), *TRIALS[1:]], TASK, RIG)


def test_an_event_of_one_trial_is_no_gap_and_is_told(once):
    assert once.body["verdict"] == "none"
    (warning,) = once.warnings
    assert warning.startswith("trial_01") and "release block1" in warning and "left out" in warning


@pytest.fixture(scope="module")
def always():
    return diagnose([pressed(t) for t in TRIALS], TASK, RIG)


def test_what_recurs_in_every_trial_is_a_gap(always):
    assert always.body["verdict"] != "none"
    assert always.body["where"][0]["subtask"] == "release block1"


def test_a_gap_that_recurs_is_no_event(always):
    assert not any("left out" in warning for warning in always.warnings)


def test_of_two_trials_neither_can_be_called_odd():
    found = diagnose([pressed(TRIALS[0]), TRIALS[1]], TASK, RIG)
    assert found.body["verdict"] != "none"


def test_residuals_are_clipped_beside_contact_changes_alone(once):
    given = once.problem
    z = np.full(given.whitening.weight.shape, 7.0)
    beside = given.frame.arrays.kind % 2 == 1
    assert (tamed(given, z)[beside] == BESIDE).all() and (tamed(given, z)[~beside] == 7.0).all()


def test_shares_are_of_what_the_model_leaves():
    biased = [
        replace(t, channels=t.channels | {"fy1": t.channels["fy1"] + 0.1, "fy2": t.channels["fy2"] + 0.1})
        for t in TRIALS
    ]
    found = diagnose(biased, TASK, RIG).body

    def share(subtask: str) -> float:
        return sum(w["share"] for w in found["where"] if w["channel"] == "fy" and w["subtask"] == subtask)

    assert sum(w["share"] for w in found["where"]) == pytest.approx(1.0)
    # The weights take the bias up while the blocks are carried; free motion has nothing to take it up.
    assert share("release block1") > 0.1 > share("carry block1")


def test_unknown_grows_with_what_is_left_and_how_surely():
    c = load_bank().calibration
    assert (
        alien("force_bias", 3 * c.unknown_at, 1e-40, c) > 0.8 > alien("force_bias", 3 * c.unknown_at, 1e-4, c)
    )
    assert alien("force_bias", 0.3, 1e-40, c) > 0.95
    assert alien("force_bias", 0.003, 1e-10, c) < 0.5
    assert alien("force_lag", 0.1, 1e-10, c) < alien("force_bias", 0.1, 1e-10, c)  # coarse in time
    assert alien("force_bias", 0.9, 0.5, c) < 0.05  # noise
