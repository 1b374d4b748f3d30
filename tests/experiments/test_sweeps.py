"""The sweep runner and what it measures: nothing lost, nothing repeated, the scores right."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.sweeps.cells import CHUNK, PLANE, SWEEPS, Cell, Unit, units
from experiments.sweeps.free_hmm import label_freely
from experiments.sweeps.measure import measure
from experiments.sweeps.methods import boundaries_of, numbered_states, segmentation_from, unsqueezed
from experiments.sweeps.results import summarise
from experiments.sweeps.tables import BEGIN, END, between
from experiments.sweeps.trials import interpolated, record_cell, recording_rig, ringing, scene, stated_rig
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.signals import task_space

ROOT = Path(__file__).resolve().parents[2]


def test_the_plan_has_two_hundred_trials_on_the_plane_and_no_unit_twice():
    plan = units()
    assert len({u.key for u in plan}) == len(plan)
    trials = Counter()
    for unit in plan:
        trials[unit.cell] += CHUNK
    assert all(trials[cell] >= 200 for cell in PLANE)
    assert {cell.noise for cell in PLANE} == {0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0}
    assert set(trials) == {cell for sweep in SWEEPS.values() for cell in sweep.values()}
    assert {u.key for u in units(small=True)} < {u.key for u in plan}
    assert Cell(noise=4.0, stated=False).key == "noise=4_stated=0"
    assert SWEEPS["rate"][20.0].key == "nominal"


@pytest.fixture(scope="module")
def usual():
    rig, task = scene()
    return rig, task, record_cell(Cell(), [5, 6], rig, task)


def test_a_trial_depends_on_its_cell_and_number_alone(usual):
    rig, task, (five, six) = usual
    six_again, seven, five_again = record_cell(Cell(), [6, 7, 5], rig, task)
    for one, other in ((five, five_again), (six, six_again)):
        assert one.blocks == other.blocks
        np.testing.assert_array_equal(one.boundaries, other.boundaries)
        for name in one.trial.channels:
            np.testing.assert_array_equal(one.trial.channels[name], other.trial.channels[name])
    assert seven.blocks != five.blocks


def test_noise_scales_and_everything_else_stays(usual):
    rig, task, (five, six) = usual
    quiet, loud = (record_cell(Cell(noise=n), [5, 6], rig, task)[0] for n in (0.25, 4.0))
    for name in ("q11", "dq22", "fy1"):
        one, high, low = (r.trial.channels[name] for r in (five, loud, quiet))
        np.testing.assert_allclose(high - one, 4 * (one - low), atol=1e-12)  # 3 and 0.75 of one draw
    np.testing.assert_array_equal(five.boundaries, loud.boundaries)
    assert recording_rig(Cell(noise=4.0), rig).noise.force == pytest.approx(4 * rig.noise.force)
    assert stated_rig(Cell(noise=4.0, stated=False), rig).noise.force is None
    assert five.trial.t.size == six.trial.t.size or five.boundaries[-1] != six.boundaries[-1]


def test_lost_values_are_as_many_as_asked_and_are_filled_in(usual):
    rig, task, (five, _) = usual
    lost = record_cell(Cell(missing=0.2), [5, 6], rig, task)[0].trial
    gone = np.isnan(np.stack(list(lost.channels.values())))
    assert gone.mean() == pytest.approx(0.2, abs=0.03)
    filled = interpolated(lost)
    for name, values in filled.channels.items():
        kept = ~np.isnan(lost.channels[name])
        np.testing.assert_array_equal(values[kept], five.trial.channels[name][kept])
        assert np.isfinite(values).all()


def test_ringing_is_the_impulse_response_of_a_damped_mode():
    t = np.linspace(0, 1, 200_001)
    wave = ringing(t, np.array([0.25, np.nan]), 20.0, np.array([-1.0, 1.0]))
    assert not wave[t <= 0.25].any()
    slope, bend = np.gradient(wave, t), np.gradient(np.gradient(wave, t), t)
    later = (t > 0.26) & (t < 0.6)
    decay = 0.05 * 2 * np.pi * 20
    omega = 2 * np.pi * 20
    residual = bend + 2 * decay * slope + (omega**2 + decay**2) * wave  # its equation of motion
    assert np.abs(residual[later]).max() < 1e-4 * np.abs(bend[later]).max()
    assert slope[t > 0.25][1] == pytest.approx(-omega, rel=1e-2)


def test_boundaries_next_to_a_missing_subtask_are_unknown():
    _, task = scene()
    steps = subtasks(task)
    whole = segmentation_from(steps, range(9), np.arange(10.0))
    np.testing.assert_array_equal(boundaries_of(whole, steps).median, np.arange(1.0, 9.0))
    assert whole.complete
    shown = [0, 1, 2, 4, 5, 6, 7, 8]  # no place of block 1
    gappy = segmentation_from(steps, shown, np.arange(9.0))
    found = boundaries_of(gappy, steps)
    np.testing.assert_array_equal(np.isnan(found.median), [0, 0, 1, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(found.median[[0, 1, 4, 7]], [1.0, 2.0, 4.0, 7.0])
    assert gappy.failed is not None and gappy.failed.subtask == "place"


def test_the_unconstrained_model_finds_the_states_of_a_clean_trial(usual):
    rig, task, (five, _) = usual
    thinned, labels = label_freely(task_space(five.trial, rig))
    truth = numbered_states(subtasks(task), five.boundaries, thinned.t)
    assert np.mean(labels.state == truth) > 0.97
    np.testing.assert_array_equal(thinned.t, five.trial.t)


def test_pads_are_taken_out_of_what_the_paper_formulas_see(usual):
    rig, _, (five, _) = usual
    signals = task_space(five.trial, rig)
    inside = (signals.t > five.boundaries[1]) & (signals.t < five.boundaries[2])
    width = five.blocks["block1"].width
    rigid = np.median(signals.distance[inside]) - width
    assert rigid < -8e-4  # two pads of 4000 N/m under 1.8-3.1 N of grip
    assert abs(np.median(unsqueezed(signals, rig).distance[inside]) - width) < 5e-5


def fabricated(trials: int, residual: float | None) -> list[dict]:
    """Trials in which every method is off by `residual` everywhere, the baseline by twice that."""
    double = None if residual is None else 2 * residual
    scores = {"residual": [residual] * 8, "accuracy": 0.9, "property": [0.01, -0.02, 0.03] * 2}
    ours = scores | {"inside_90": [1.0] * 6 + [0.0] * 2, "inside_95": [1.0, 1.0, 0.0, 1.0, 1.0, None]}
    qualitative = {
        "residual": [[double] * 8] * 48 + [[residual] * 8], "inside_90": [[1.0] * 8] * 49,
        "accuracy": [0.5] * 48 + [0.8], "sample_accuracy": [0.4] * 49,
        "property": [[0.2] * 6] * 3 + [[0.1] * 6] * 4,
    }  # fmt: skip
    rest = {"property": [0.01] * 6, "rigid": [0.05] * 6}
    return [{"trial": k, "ours": ours, "unconstrained": scores | {"sample_accuracy": 0.7},
             "qualitative": qualitative, "true_spans": rest} for k in range(trials)]  # fmt: skip


def test_results_are_medians_shares_and_the_best_in_hindsight():
    cell = summarise(fabricated(10, -0.01))
    ours, hindsight = cell["methods"]["ours"], cell["methods"]["hindsight"]
    assert cell["trials"] == 10
    assert ours["boundary_median"] == {"value": 0.01, "interval_95": [0.01, 0.01]}
    assert ours["coverage_90"]["value"] == 0.75
    assert ours["coverage_95"]["value"] == pytest.approx(0.8)
    assert ours["coverage_95_height"]["value"] == 0.0  # block 1's, the other is null
    assert (ours["weight"]["value"], ours["width"]["value"]) == (0.01, 0.02)
    assert cell["methods"]["qualitative"][3]["boundary_median"]["value"] == 0.02
    assert hindsight["boundary_median"]["value"] == 0.01
    assert hindsight["boundary_median"]["thresholds"] == [10.0, 10.0]
    assert (hindsight["accuracy"]["value"], hindsight["weight"]["value"]) == (0.8, 0.1)


def test_what_is_not_found_counts_as_infinitely_wrong():
    lost = fabricated(3, None) + fabricated(2, 0.01)
    cell = summarise(lost)["methods"]["ours"]
    assert cell["boundary_median"]["value"] is None
    assert cell["boundaries_found"]["value"] == 0.4
    found = summarise(fabricated(2, None) + fabricated(3, 0.01))["methods"]["ours"]
    assert found["boundary_median"]["value"] == 0.01
    assert found["boundary_95"]["value"] is None
    json.dumps(found, allow_nan=False)


def test_tables_replace_what_lies_between_their_markers():
    text = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    assert between(text, "new") == f"before\n{BEGIN}\n\nnew\n\n{END}\nafter\n"
    with pytest.raises(ValueError, match="marker"):
        between("no markers", "new")


def test_units_carry_all_that_is_needed_to_do_them_elsewhere():
    import pickle

    unit = Unit(Cell(noise=4.0), 32)
    assert pickle.loads(pickle.dumps(unit)) == unit
    assert list(unit.trials) == list(range(32, 48))
    assert replace(unit, cell=Cell()).key == "nominal.0032"


@pytest.mark.slow
def test_one_unit_from_end_to_end():
    result = measure(Unit(Cell(noise=4.0), 16))
    json.dumps(result, allow_nan=False)
    assert [trial["trial"] for trial in result["trials"]] == list(range(16, 32))
    assert sum("sampled" in trial["ours"] for trial in result["trials"]) == 1
    methods = summarise(result["trials"])["methods"]
    ours, paper = methods["ours"], methods["qualitative"][3]
    assert ours["boundary_median"]["value"] < 0.2 * paper["boundary_median"]["value"]
    assert methods["hindsight"]["accuracy"]["value"] >= paper["accuracy"]["value"]
    assert methods["rigid"]["width"]["value"] > 0.04  # a millimetre of pads
    assert methods["true_spans"]["width"]["value"] < 0.002
