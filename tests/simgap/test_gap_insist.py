"""A hand whose forces mislead the alignment is diagnosed; a recording of something else is still refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK, TRIALS

from hmmseg.errors import InputError
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align
from simgap.gap.diagnose import diagnose


def turned(trial: Trial, angles: tuple[float, float]) -> Trial:
    """A trial whose sensors are turned by so many radians."""
    channels = dict(trial.channels)
    for finger, angle in zip((1, 2), angles, strict=True):
        x, y = channels[f"fx{finger}"], channels[f"fy{finger}"]
        channels[f"fx{finger}"] = np.cos(angle) * x - np.sin(angle) * y
        channels[f"fy{finger}"] = np.sin(angle) * x + np.cos(angle) * y
    return replace(trial, channels=channels)


def test_turned_sensors_that_hide_the_lift_are_named():
    angles = (-0.09, 0.09)
    trials = [turned(t, angles) for t in TRIALS]
    aligned = align(trials, TASK, RIG)
    assert not any(t.segmentation.complete for t in aligned.trials)
    found = diagnose(trials, TASK, RIG)
    assert found.body["causes"] == ["sensor_rotation"]
    for key, angle in zip(("angle1", "angle2"), angles, strict=True):
        low, high = found.body["effects"]["sensor_rotation"]["parameters"][key]["interval_90"]
        assert low - 0.01 < angle < high + 0.01
    assert "without sensor_rotation it fits" in found.warnings[0]


def test_recordings_of_another_task_are_refused():
    with pytest.raises(InputError, match="does not fit its task at "):
        diagnose(TRIALS, replace(TASK, moves=TASK.moves[:1]), RIG)
