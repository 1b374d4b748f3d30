"""What real recordings tell, and the paper's recording with rigid pads; skipped where the data are absent."""

import numpy as np
import pytest

from experiments.paper.paper_gap import rigid
from experiments.paper.sources import recorded
from experiments.real import hiro_snap, robot_gap
from hmmseg.io.task import SequenceTask
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.segment import segment_sequence

FOUR = [f"xl330_{n}" for n in ("kp100_sin_sin", "kp200_up_and_down", "kp400_lift_and_drop",
                               "kp800_sin_time_square")]  # fmt: skip
NOT_THERE = ("backlash", "delay", "spring", "stribeck", "sag", "mass", "length")


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


@pytest.mark.slow
def test_rigid_fingertips_are_diagnosed_again():
    from hmmseg.segmentation.align import align
    from simgap.gap.diagnose import diagnose

    case = recorded()
    found = diagnose(align(list(case.trials[:2]), case.task, rigid(case.rig)))
    assert found.body["causes"] == ["fingertip_compliance"]


@pytest.mark.slow
def test_what_a_servo_lacks_is_named(shared):
    """One log a gain: friction by load, the rotor and a fade, and the logs left out are predicted."""
    found = robot_gap.summary(robot_gap.run(shared / "real/xl330_pendulum", FOUR))
    assert found["verdict"] in ("named", "set")
    causes = found["causes"]
    assert {"armature", "load_friction"} <= set(causes) and any(c.endswith("fade") for c in causes)
    assert not [c for c in causes for none in NOT_THERE if none in c]
    rms = found["shrinkage"]["rms"]["position"]
    assert rms["after"] < 0.5 * rms["before"] and found["remainder"]["share"] < 0.3
