"""The fit on recordings: healthy ones are noise, a planted effect is found with its parameters."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg.io.trial import read_trial
from hmmseg.segmentation.align import align
from simgap.gap.bank import load_bank
from simgap.gap.fit import Start, fit, neutral, problem, residual_at, slots
from simgap.gap.frame import build
from simgap.gap.judge import heldout, log_evidence, probabilities
from simgap.gap.locate import cells, largest, normal_score
from simgap.gap.spread import quantised


def read(folder, count=2):
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    trials = [read_trial(folder / f"trial_{k:02d}.csv", rig) for k in range(1, count + 1)]
    aligned = align(trials, task, rig)
    return build(trials, aligned, rig)


@pytest.fixture(scope="module")
def healthy(shared):
    given = problem(read(shared / "recordings/none_1"), load_bank().noise)
    return given, fit(given, [Start((), neutral(given))])[0]


def test_a_healthy_recording_is_noise(healthy):
    given, found = healthy
    z = residual_at(given, (), found.u)
    there = given.whitening.weight > 0
    assert 0.7 < np.mean(z[there] ** 2) < 1.1
    assert min(load_bank().detection.p_values(largest(cells(given, z))).values()) > 0.05


def test_no_force_bias_is_found_in_a_healthy_recording(healthy):
    given, found = healthy
    biased = fit(given, [Start(("force_bias",), neutral(given))])[0]
    assert log_evidence(given, biased, found) < 0
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == "force_bias")
    assert np.abs(0.1 * biased.u[slot.start : slot.stop]).max() < 0.005


def test_a_force_bias_is_recovered(shared):
    given = problem(read(shared / "recordings/force_bias_1"), load_bank().noise)
    labels = json.loads((shared / "recordings/labels.json").read_text())
    truth = next(e for e in labels if e["case"] == "force_bias_1")["params"]["bias"]
    plain, biased = (fit(given, [Start(e, neutral(given))])[0] for e in ((), ("force_bias",)))
    slot = next(s for s in slots(given.num_properties)[0] if s.effect.name == "force_bias")
    np.testing.assert_allclose(0.1 * biased.u[slot.start : slot.stop], truth, atol=0.004)
    assert log_evidence(given, biased, plain) > 1000


def test_a_gain_cannot_win_by_scaling_the_noise(healthy):
    given, found = healthy
    scaled = fit(given, [Start(("force_gain",), neutral(given))])[0]
    assert found.cost - scaled.cost < 8


def test_held_out_squares_agree_with_refitting(healthy):
    """Left out by trial: the quadratic forms against a fit that never saw the trial."""
    given, found = healthy
    labels = np.broadcast_to(np.arange(4)[:, None], found.square.shape)
    out = heldout(given, found, labels, given.frame.num_trials)
    hessian, gradient = found.hessian[1].sum(0), found.gradient[1].sum(0)  # trial 1 alone tells trial 0
    step = np.linalg.solve(hessian + np.eye(len(gradient)), -(gradient + found.u[found.columns]))
    other = (
        found.square[0] + 2 * found.gradient[0] @ step + np.einsum("i,sij,j->s", step, found.hessian[0], step)
    )
    np.testing.assert_allclose(out[0], other, rtol=1e-9)
    assert out.sum() > found.square[:2].sum()  # never better than what was fitted


def test_quantisation_is_seen_and_not_imagined(healthy):
    given, found = healthy
    assert quantised(given, residual_at(given, (), found.u)).evidence < 0
    coarse = given.frame.world._replace(force=0.04 * np.round(given.frame.world.force / 0.04))
    frame = type(given.frame)(**{**vars(given.frame), "world": coarse})
    rounded = type(given)(frame, given.whitening, given.centre, given.spread)
    seen = quantised(rounded, residual_at(rounded, (), found.u))
    assert seen.evidence > 100
    assert seen.value == pytest.approx(0.04, rel=1e-6)


def test_normal_scores_are_standard_normal():
    rng = np.random.default_rng(1)
    scores = normal_score(rng.chisquare(20, 20000), 20)
    assert abs(scores.mean()) < 0.03
    assert abs(scores.std() - 1) < 0.03


def test_probabilities_sum_to_one_and_follow_the_evidence():
    p = probabilities({"force_bias": 30.0, "force_drift": 3.0}, 0.01, 0.5, load_bank().calibration)
    assert sum(p.values()) == pytest.approx(1.0)
    assert max(p, key=lambda k: p[k]) == "force_bias"
    alien = probabilities({"force_bias": 30.0}, 0.9, 1e-30, load_bank().calibration)
    assert alien["unknown"] > 0.9
