"""Real recordings beside the checkout; skipped where they are absent."""

import numpy as np
import pytest

from experiments.real import hiro_snap
from hmmseg.errors import InputError


def test_snap_trials_are_read_and_cropped(shared):
    trials = hiro_snap.read_kind(shared / "real/hiro_snap", "real_guarded")
    assert len(trials) == 7
    trial, labels = trials[0]
    assert trial.rate == pytest.approx(200, rel=0.01)
    assert set(hiro_snap.WRENCH_AND_POSE) <= set(trial.channels)
    np.testing.assert_allclose(labels, [7.075, 15.385, 16.325])
    assert hiro_snap.cropped(trial, 2.0).t[0] == pytest.approx(2.0, abs=0.006)


def test_malformed_snap_trials_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"R_Torques.dat: cannot be read"):
        hiro_snap.read_trial(tmp_path)
    for name in ("R_Torques.dat", "R_CartPos.dat", "R_State.dat"):
        (tmp_path / name).write_text("0 1 2\n1 2 3\n")
    with pytest.raises(InputError, match="has 3 columns; expected t and six more"):
        hiro_snap.read_trial(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["real_guarded", "real_pivot"])
def test_snap_boundaries(shared, kind):
    trials = hiro_snap.read_kind(shared / "real/hiro_snap", kind)
    description = hiro_snap.KINDS[kind]
    taught, clock = hiro_snap.with_labels(trials, description, hiro_snap.WRENCH_AND_POSE, seed=11)
    assert max(hiro_snap.summary(taught)["median_abs"]) <= 0.06
    assert np.median(np.abs(clock)) > 0.2  # the crop leaves the clock nothing
    alone = hiro_snap.without_labels(trials, description, hiro_snap.WRENCH_AND_POSE, seed=11)
    assert min(hiro_snap.summary(alone)["within_0.3"]) == 1.0
