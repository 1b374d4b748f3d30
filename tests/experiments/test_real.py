"""Real recordings beside the checkout; skipped where they are absent."""

import numpy as np
import pytest

from experiments.real import hiro_snap
from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.segment import segment_sequence


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


# Recordings do not tell which of their changes the task names. Where their number leaves that open, as on
# guarded trials for the mating, the reported time is one of several listed places, and one labelled trial
# decides.
@pytest.mark.slow
@pytest.mark.parametrize(("kind", "decided"), [("real_guarded", [0]), ("real_pivot", [0, 1])])
def test_snap_boundaries(shared, kind, decided):
    trials = hiro_snap.read_kind(shared / "real/hiro_snap", kind)
    description = hiro_snap.KINDS[kind]
    taught, clock = hiro_snap.with_labels(trials, description, hiro_snap.WRENCH_AND_POSE, seed=11)
    assert max(hiro_snap.summary(taught)["median_abs"]) <= 0.06
    assert np.median(np.abs(clock)) > 0.2  # the crop leaves the clock nothing
    alone = hiro_snap.summary(hiro_snap.without_labels(trials, description, hiro_snap.WRENCH_AND_POSE,
                                                       seed=11))  # fmt: skip
    assert min(np.array(alone["within_0.3"])[decided]) == 1.0 and min(alone["coverage_90"]) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["real_guarded", "real_pivot"])
def test_snap_boundaries_are_listed_and_one_labelled_trial_decides(shared, kind):
    description, rng = hiro_snap.KINDS[kind], np.random.default_rng(11)
    task = SequenceTask(description.sequence, hiro_snap.WRENCH_AND_POSE)
    trials, labels = zip(*hiro_snap.read_kind(shared / "real/hiro_snap", kind), strict=True)
    trials = [hiro_snap.cropped(trial, rng.uniform(0, hiro_snap.MAX_CROP)) for trial in trials]
    model = fit_sequence(trials, task, {trials[0].file: labels[0]})
    alone, decided = segment_sequence(trials, task), segment_sequence(trials[1:], task, model)
    for b in description.scored:
        for found, label in zip(alone, labels, strict=True):
            span = found.spans[1:][b]
            places = [place.time for place in span.alternatives] or [span.start]
            assert min(abs(time - label[b]) for time in places) < 0.3
        for found, label in zip(decided, labels[1:], strict=True):
            assert abs(found.spans[1:][b].start - label[b]) < 0.3
