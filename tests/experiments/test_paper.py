"""The paper's reproduction: results from the data, a page that says them; real recordings."""

import json

import numpy as np
import pytest
from matplotlib.image import imread
from refusals import refused

from experiments.paper import estimates, recording, rigid, slip, sources, tables, write_docs
from experiments.paper.paper_gap import rigid as with_rigid_pads
from experiments.paper.sources import recorded
from experiments.real import hiro_snap
from experiments.saving import commit_of
from hmmseg.plot import style as drawing
from paper_figs import __main__ as figures
from paper_figs import results
from paper_figs.results import RESULTS


@pytest.fixture(scope="module")
def case():
    return sources.recorded()


@pytest.fixture(scope="module")
def shortfalls(case):
    return rigid.shortfalls(case)


def test_stiffness_and_widths_follow_from_the_recordings_and_rigid_pads_are_short(shortfalls, case):
    assert len(shortfalls) == 20
    for name in sources.BLOCKS:
        rows = [row for row in shortfalls if row["object"] == name]
        assert 1.0e-3 < np.mean([row["short"] for row in rows]) < 1.6e-3
    for row in shortfalls:
        assert row["short"] == pytest.approx(row["predicted"], abs=3e-5) and abs(row["remaining"]) < 3e-5
    for name, width in rigid.ACTUAL.items():
        found = rigid.from_the_data(case, name)
        assert found["stiffness"] == pytest.approx(4000, rel=0.03)
        assert found["width"] == pytest.approx(width, abs=3e-5)


def test_states_come_in_the_expected_order_and_as_the_papers_table_2_has_them(case):
    rows = recording.trials(case)
    assert all(row["ordered"] == list(recording.EXPECTED) for row in rows)
    assert rows[sources.ONE]["sequence"] == list(recording.EXPECTED)
    assert sum(row["flickers"] > 0 for row in rows) >= 1  # the weakness is there to be seen
    rows = {row.pop("state"): row for row in tables.table_2()}
    assert rows["free-motion"] == {"vx": "", "vy": "", "fx": "0", "fy": "0", "grip": "0", "shear": "0"}
    on_ground = {"vx": "0", "vy": "0", "fx": "", "fy": "- or 0", "grip": "+", "shear": ""}
    assert rows["hold-on-ground"] == on_ground
    assert rows["hold-on-ground, sliding"] == on_ground | {"vx": "+ or -"}
    assert rows["hold-above-ground"] == {"vx": "", "vy": "", "fx": "", "fy": "+", "grip": "+", "shear": ""}


def test_slip_adds_to_heights_with_its_sign(case):
    weight = case.blocks["block2"]["weight"][0]
    lifted = slip.stack(case.rig, 1.12 * weight / (2 * slip.GRIP), slip.LIGHT)
    landed = slip.stack(case.rig, 1.6 * weight / (2 * slip.GRIP), 1.5e-3)
    assert lifted.slip > 5e-4 and landed.slip < -5e-4
    for placed in (lifted, landed):
        assert placed.residual == pytest.approx(placed.slip, abs=1.5e-4)
    found = slip.heights(sources.recorded("grip_slip_1"))
    assert found["block1"]["compliant"]["mean"] < -1e-4 and found["block2"]["compliant"]["mean"] > 1e-4


def test_numbers_are_saved_as_recorded_without_nan_and_read_back(case, monkeypatch, tmp_path):
    saved = results.load("estimates")["table_4"]["recordings"]["paper"]
    fresh = estimates.by_formula(case)
    for which in ("one", "all"):
        for name in sources.BLOCKS:
            for key in estimates.KEYS:
                old, new = (found[which][name][key]["mean"] for found in (saved, fresh))
                assert old == pytest.approx(new, rel=1e-5)
    assert results.load("states")["recordings"] == json.loads(json.dumps(recording.trials(case)))
    monkeypatch.setattr(sources, "RESULTS", tmp_path)
    sources.save("some", {"a": np.array([1.23456789, np.nan, -0.0]), "b": [{"c": True, "d": np.int64(3)}],
                          "e": []})  # fmt: skip
    text = (tmp_path / "some.json").read_text(encoding="utf-8")
    read = json.loads(text)
    assert read.pop("made_by", None) == commit_of()
    assert read == {"a": [1.23457, None, 0.0], "b": [{"c": True, "d": 3}], "e": []}


def test_the_page_is_rendered_from_the_results_and_they_bear_out_its_words():
    assert write_docs.TARGET.read_text(encoding="utf-8") == write_docs.render()
    replay, slid, alike = (results.load(name) for name in ("replay", "slip", "alike"))
    for trial in replay["trials"]:
        assert max(trial["free-motion"], trial["hold-above-ground"]) <= replay["limit"]
    assert slid["example"]["residual"] == pytest.approx(slid["long"], abs=1e-4)
    for covered in alike["simulated"]["hmm"]["coverage"].values():
        assert covered["holds"] or covered["share"] > covered["nominal"]
    bayes = results.load("rigid")["bayes"]
    for name, width in rigid.ACTUAL.items():
        assert width - bayes["rigid"][name]["mean"] > 20 * bayes["rigid"][name]["sd"]


@pytest.mark.parametrize("name", figures.FIGURES)
def test_figures_draw_from_saved_results(name, monkeypatch, tmp_path):
    monkeypatch.setattr(results, "FIGURES", tmp_path)
    monkeypatch.setattr(drawing, "DPI", 40)
    figures.FIGURES[name]()
    assert imread(tmp_path / f"{name}.png").std() > 0.02


def test_snap_trials_are_read_and_cropped_or_refused(shared, tmp_path):
    trials = hiro_snap.read_kind(shared / "real/hiro_snap", "real_guarded")
    assert len(trials) == 7
    trial, labels = trials[0]
    assert trial.rate == pytest.approx(200, rel=0.01)
    assert set(hiro_snap.WRENCH_AND_POSE) <= set(trial.channels)
    np.testing.assert_allclose(labels, [7.075, 15.385, 16.325])
    assert hiro_snap.cropped(trial, 2.0).t[0] == pytest.approx(2.0, abs=0.006)
    refused(r"R_Torques.dat: cannot be read", hiro_snap.read_trial, tmp_path)
    for name in ("R_Torques.dat", "R_CartPos.dat", "R_State.dat"):
        (tmp_path / name).write_text("0 1 2\n1 2 3\n")
    refused("has 3 columns; expected t and six more", hiro_snap.read_trial, tmp_path)


def test_the_published_case_of_rigid_fingertips_blames_the_pads_and_no_slip():
    rig = recorded().rig
    assert np.isinf(with_rigid_pads(rig).fingertip.normal_stiffness)
    assert with_rigid_pads(rig).fingertip.shear_stiffness == rig.fingertip.shear_stiffness
    saved = json.loads((RESULTS / "gap.json").read_text())
    for name in ("rigid", "rigid_with_actual"):
        entry = saved[name]
        assert (entry["verdict"], entry["causes"]) == ("named", ["fingertip_compliance"])
        assert entry["slip_probability"] < 0.01
        for block in ("block1", "block2"):
            width = entry["properties"][f"{block}.width"]
            assert width["before_error"] == pytest.approx(-1.3e-3, abs=0.2e-3)
            assert abs(width["after_error"]) < 5e-5
    assert saved["nominal"]["verdict"] == "none"
