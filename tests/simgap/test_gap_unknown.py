"""What no effect explains is unknown: what one trial alone bears out, what stays, what errs alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from experiments.gap_cases import draw_case
from hmmseg.errors import InputError
from hmmseg.io.trial import Trial
from simgap.gap.bank import load_bank
from simgap.gap.diagnose import diagnose
from simgap.gap.judge import ALIKE, alien, log_evidence


def changed(trial: Trial, **added) -> Trial:
    """A trial with values added to some channels."""
    return replace(
        trial, channels=trial.channels | {c: trial.channels[c] + value for c, value in added.items()}
    )


def test_what_one_trial_alone_bears_out_is_not_named():
    # The sensors were set to zero anew after the first trial.
    off = {"fx1": 0.03, "fy1": -0.06, "fx2": 0.05, "fy2": 0.08}
    found = diagnose([changed(TRIALS[0], **off), *TRIALS[1:]], TASK, RIG)
    bias = next(c for c in found.candidates if c.name == "force_bias")
    claimed = log_evidence(found.problem, bias.fitted, found.healthy, temperature=3.0)
    assert claimed > 20 > bias.evidence
    assert found.body["verdict"] == "unknown"
    every = diagnose([changed(t, **off) for t in TRIALS], TASK, RIG)
    assert every.body["causes"] == ["force_bias"]


def test_what_raised_the_alarm_and_is_still_there_was_not_explained():
    c = load_bank().calibration
    assert alien("structural_vibration", 0.0, 1e-9, c, 1e-9) > 0.8
    assert alien("structural_vibration", 0.0, 1e-9, c, 1e-40) < 0.2
    assert alien("structural_vibration", 0.0, 0.3, c, 1e-3) < 0.2  # what is left is noise


@pytest.mark.parametrize(
    ("rates", "verdict"),
    [((0.02, 0.012, -0.007, 0.016), "named"), ((0.02, 0.0, -0.02, 0.0), "unknown")],
)
def test_channels_that_drift_alike_have_one_cause(rates, verdict):
    names = ("fx1", "fy1", "fx2", "fy2")
    drifting = [changed(t, **{c: rate * t.t for c, rate in zip(names, rates, strict=True)}) for t in TRIALS]
    found = diagnose(drifting, TASK, RIG)
    assert found.body["verdict"] == verdict
    alike = next(c for c in found.candidates if c.name == "force_drift" + ALIKE)
    plain = next(c for c in found.candidates if c.name == "force_drift")
    assert (alike.evidence > plain.evidence) == (verdict == "unknown")
    assert any("err alike" in w for w in found.warnings) == (verdict == "unknown")


def test_a_half_that_goes_better_with_another_is_exchanged():
    # A cable and a bias alone explain more than the mass does, and go with a rotation: both are wrong.
    case = draw_case("pair", ("fingertip_mass", "force_crosstalk"), 3, TASK, RIG)
    found = diagnose(case.trials, TASK, RIG)
    assert found.body["causes"] == ["fingertip_mass", "force_crosstalk"]


def test_a_trial_that_fits_no_task_says_where():
    still = [replace(t, channels={c: np.full_like(v, v[0]) for c, v in t.channels.items()}) for t in TRIALS]
    with pytest.raises(InputError, match="does not fit its task at "):
        diagnose(still, TASK, RIG)
