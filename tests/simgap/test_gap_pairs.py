"""Which second effects are offered and which pay; what measured blocks bear out; what pushes a hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import FOLDER, RIG, TASK, TRIALS

from estimation.actual import read_actual
from hmmseg.io.trial import Trial
from simgap.effects.base import FORCES
from simgap.gap.affected import HAND, shifts
from simgap.gap.diagnose import Diagnosis, diagnose
from simgap.gap.fit import slots
from simgap.gap.frame import CHANNELS

STEP = 0.03  # N; rounding to it scatters by 0.009, where the sensors' noise is 0.012


def changed(trial: Trial, change) -> Trial:
    """A trial with its forces changed."""
    return replace(trial, channels=trial.channels | {c: change(trial.channels[c]) for c in FORCES})


def rounded(trial: Trial, bias: float = 0.0) -> Trial:
    """A trial with a small bias [N] whose forces are rounded."""
    return changed(trial, lambda f: np.round((f + bias) / STEP) * STEP)


def test_rounding_alone_has_no_second_cause():
    found = diagnose([rounded(t) for t in TRIALS], TASK, RIG)
    assert found.body["causes"] == ["quantisation"] and found.body["verdict"] == "named"


def test_rounding_is_noise_to_what_goes_with_it():
    found = diagnose([rounded(t, 0.008) for t in TRIALS], TASK, RIG)
    evidence = {c.name: c.evidence for c in found.candidates}
    beside = evidence["force_bias+quantisation"] - evidence["quantisation"]
    assert 50 < beside < 0.8 * evidence["force_bias"]


def test_what_is_excluded_is_no_half_of_a_pair():
    found = diagnose([rounded(t, 0.08) for t in TRIALS], TASK, RIG, excluded=["quantisation"])
    assert any("force_bias" in c.effects and len(c.effects) == 1 for c in found.candidates)
    assert found.candidates[0].evidence > 20  # enough for pairs to be tried
    assert not any("quantisation" in c.name for c in found.candidates)


def test_measured_blocks_bear_out_a_length_that_no_trial_shows():
    # Links that are 1 % longer than the rig says make every width and height as much too small.
    shorter = {
        n: f.model_copy(update={"links": tuple(v / 1.01 for v in f.links)}) for n, f in RIG.fingers.items()
    }
    wrong = RIG.model_copy(update={"fingers": shorter})
    found = diagnose(TRIALS, TASK, wrong, read_actual(FOLDER / "actual.toml", TASK.objects))
    assert found.body["causes"] == ["link_length"]
    length = found.body["effects"]["link_length"]
    assert length["heldout_score"] < 0.3 * length["log_evidence"]


def _noise(found: Diagnosis, subtask: int) -> np.ndarray:
    """Noise (C,) of one sample in a subtask of the first trial, the harmonic mean of its samples'."""
    arrays = found.problem.frame.arrays
    return 1 / np.mean(1 / arrays.sample[0][arrays.subtask[0] == subtask], axis=0)


def test_a_cable_displaces_the_hand_that_bears_it():
    found = diagnose(TRIALS, TASK, RIG, forced=["cable_force"])
    (cable,) = found.candidates
    slot = next(s for s in slots(found.problem.num_properties)[0] if s.effect.name == "cable_force")
    u = cable.fitted.u.copy()
    u[slot.start : slot.stop] = [
        p.coordinate(v) for p, v in zip(slot.effect.parameters, (0.0, 0.1, -0.2), strict=True)
    ]
    mean = shifts(found.problem, replace(cable, fitted=replace(cable.fitted, u=u)))
    mean = mean[0, 0]  # before any contact
    noise = _noise(found, 0)
    for path, force, pull in (("x", "fx", 0.1), ("y", "fy", 0.2)):
        p, f = CHANNELS.index(path), CHANNELS.index(force)
        assert mean[f] * noise[f] == pytest.approx(2 * pull)
        assert mean[p] * noise[p] == pytest.approx(pull / HAND)


@pytest.mark.parametrize("effect", ["fingertip_creep", "fingertip_compliance"])
def test_a_hand_grips_the_less_the_farther_pads_creep(effect):
    found = diagnose(TRIALS, TASK, RIG, forced=[effect])
    (pads,) = found.candidates
    values = {"ratio": 0.8, "time_constant": 0.5, "give_normal": 2.5e-4}
    slot = next(s for s in slots(found.problem.num_properties)[0] if s.effect.name == effect)
    u = pads.fitted.u.copy()
    u[slot.start : slot.stop] = [
        p.coordinate(values[p.name]) if p.name in values else u[slot.start + j]
        for j, p in enumerate(slot.effect.parameters)
    ]
    mean = shifts(found.problem, replace(pads, fitted=replace(pads.fitted, u=u)))
    noise = _noise(found, 1)
    grip, distance = (mean[0, 1, k] * noise[k] for k in map(CHANNELS.index, ("grip", "distance")))
    assert distance > 1e-4
    if effect == "fingertip_creep":
        assert grip == pytest.approx(HAND * distance / 2, rel=0.05)
    else:  # people close their fingers until they feel the grip that they want
        assert grip < 0.1 * HAND * distance / 2
