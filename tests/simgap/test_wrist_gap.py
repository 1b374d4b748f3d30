"""The diagnosis of a hand with a sensor in its wrist: only what the wrist feels is compared."""

import numpy as np
import pytest

from experiments.wrist_scene import TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.segmentation.align import align
from simgap.gap.diagnose import diagnose
from simgap.gap.frame import CHANNELS, build, shown, shown_forms
from simgap.gap.search import candidate_names


@pytest.fixture(scope="module")
def recordings():
    return [wrist_recording(s, Setup(), i) for i, s in enumerate(performances(2))]


def read_all(recordings, **said):
    rig = wrist_rig(Setup(), **said)
    return [read_trial(columns, rig) for columns in recordings], rig


@pytest.mark.parametrize(("said", "more"), [({}, set()), ({"grip_force": "grip"}, {"distance", "grip"})])
def test_channels_that_a_wrist_has_not_are_compared_with_nothing(recordings, said, more):
    with_grip = [columns | {"grip": np.where(columns["gap"] < 0.045, 10.0, 0.0)} for columns in recordings]
    trials, rig = read_all(with_grip, **said)
    there = build(align(trials, TASK, rig)).arrays.there
    seen = {name for k, name in enumerate(CHANNELS) if there[..., k].any()}
    assert seen == {"x", "y", "fx", "fy"} | more


def test_effects_of_one_finger_are_not_thought_of(recordings):
    trials, rig = read_all(recordings)
    keys = shown_forms(candidate_names(rig))
    assert "force_lag" in keys and not any("/" in key for key in keys)
    with pytest.raises(InputError, match=r"force_bias.*unseen by a wrist"):
        diagnose(align(trials, TASK, rig), forced=["force_bias"])
    assert shown(["force_bias", "force_lag"]) == ["force_lag"]


@pytest.mark.slow
def test_healthy_is_none_and_late_forces_are_named(recordings):
    trials, rig = read_all(recordings)
    found = diagnose(align(trials, TASK, rig))
    assert found.body["verdict"] == "none"
    assert any("offset, shear, vx, vy, distance, grip are not" in w for w in found.warnings)
    late = []
    for columns in recordings:
        t = columns["t"]
        late.append(columns | {f"F{a}": np.interp(t - 0.06, t, columns[f"F{a}"]) for a in "xyz"})
    trials, rig = read_all(late)
    assert "force_lag" in diagnose(align(trials, TASK, rig)).body["causes"]
