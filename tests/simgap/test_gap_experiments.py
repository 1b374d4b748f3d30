"""The next experiment: what it promises to tell apart, and that it promises nothing it cannot."""

from __future__ import annotations

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.segmentation.align import align
from simgap.gap.bank import load_bank
from simgap.gap.diagnose import _inseparable
from simgap.gap.experiments import ENOUGH, next_experiment, trusted
from simgap.gap.fit import problem
from simgap.gap.frame import build
from simgap.gap.verdict import SHAPED, SHORTLY, brief, form_share

BLOCKS = np.array([[0.5, 0.018, 0.016], [0.6, 0.026, 0.016]])  # weight [N], width and height [m]
MEASURED = {
    name: {"weight": (w, 5e-4), "width": (a, 1e-4), "height": (h, 1e-4)}
    for name, (w, a, h) in zip(TASK.objects, BLOCKS.tolist(), strict=True)
}
GAIN, CROSSTALK = {"gain": 0.08}, {"fy_from_fx": 0.01, "fx_from_fy": 0.0}
SOFTER = ("fingertip_compliance",)


@pytest.fixture(scope="module")
def given():
    aligned = align(TRIALS, TASK, RIG)
    return problem(build(TRIALS, aligned, RIG), load_bank().noise)


def asked(given, cause, partners, actual=None, behind=0.0):
    return next_experiment(
        given, cause, partners, [behind] * len(partners), BLOCKS, load_bank(), 0, actual, 1.5
    )


def test_a_balance_and_calipers_tell_a_gain_from_softer_pads(given):
    found = asked(given, {"force_gain": GAIN}, [SOFTER])
    assert found is not None
    assert found["do"].startswith("weigh the blocks") and not found["operator"]
    assert found["separates"] == ["fingertip_compliance", "force_gain"]
    assert found["expected_gain_nats"] > 10 * ENOUGH


def test_blocks_that_were_measured_need_not_be_measured_again(given):
    cause, lag = {"force_lowpass": {"time_constant": 0.03}}, [("force_lag",)]
    found = asked(given, cause, lag, MEASURED, behind=1e3)
    assert found is not None and found["operator"]


def test_what_no_trial_shows_no_experiment_tells_apart(given):
    assert asked(given, {"force_gain": {"gain": 1e-4}}, [SOFTER]) is None


def test_an_experiment_names_only_what_it_tells_apart(given):
    cause = {"force_crosstalk": CROSSTALK, "force_gain": GAIN}
    partners = [("fingertip_compliance", "force_crosstalk"), ("force_gain", "sensor_rotation")]
    found = asked(given, cause, partners)
    assert found is not None
    assert found["separates"] == ["fingertip_compliance", "force_crosstalk", "force_gain"]
    assert _inseparable(list(cause), ["fingertip_compliance", "sensor_rotation"], found) == [
        "no experiment of the list is expected to tell sensor_rotation from force_crosstalk + force_gain"
    ]
    assert not _inseparable(list(cause), ["fingertip_compliance"], found)


def test_what_reshapes_signals_in_time_has_the_least_exact_forms():
    assert form_share(["force_lag"], ["force_lowpass"]) == SHAPED
    pads = form_share(["force_lag", "force_gain"], ["force_lag", *SOFTER])
    assert form_share(["force_lag"], ["force_lowpass"], brief=True) == SHORTLY > SHAPED
    assert pads < form_share(["force_lag"], ["force_gain"]) < SHAPED


def test_delays_are_brief_beside_a_sample():
    assert brief([0.012], 0.05) and not brief([0.03], 0.05)
    assert not brief([0.012, 0.03], 0.05) and not brief([], 0.05)  # what delays nothing is no brief delay


def test_a_forecast_is_trusted_as_far_as_that_of_the_recordings_at_hand_came_true():
    forecast, behind = np.array([1.0, 60.0, 60.0]), np.array([0.0, 3.0, 90.0])
    assert trusted(forecast, behind) == pytest.approx([1.0, 0.1, 1.0])
