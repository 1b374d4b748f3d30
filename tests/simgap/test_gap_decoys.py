"""Decoys: they take probability for "unknown" and are never named."""

from __future__ import annotations

import pytest

from simgap.effects import decoys
from simgap.gap.judge import Calibration, probabilities
from simgap.gap.verdict import likelihoods


@pytest.mark.parametrize("decoy", sorted(decoys()))
def test_what_a_decoy_explains_best_is_unknown(decoy):
    found = probabilities({decoy: 80.0, "force_gain": 40.0}, 0.0, 1.0, Calibration())
    assert set(found) == {"none", "unknown", "force_gain"}
    assert found["unknown"] > 0.99
    assert sum(found.values()) == pytest.approx(1.0)


def test_a_decoy_that_does_no_better_takes_nothing_away():
    found = probabilities({"force_gain": 80.0, "force_nonlinearity": 60.0}, 0.0, 1.0, Calibration())
    assert found["force_gain"] > 0.99


def test_a_decoy_without_a_gap_leaves_none():
    found = likelihoods({"gain_drift": 3.0}, 0.5, 0.0, 1.0, Calibration())
    assert found["none"] > 0.9
