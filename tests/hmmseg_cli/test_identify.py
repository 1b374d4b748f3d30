"""decompose, segment, identify and demo: the outward contract, end to end."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from estimation.report import property_rows
from hmmseg.example import example_folder
from hmmseg_cli.main import main

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
NONE = RECORDINGS / "none_1"
RIG_AND_TASK = ("--task", str(NONE / "task.toml"), "--rig", str(NONE / "rig.toml"))
SINGLE = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'
PAPER = (example_folder() / "task.toml").read_text(encoding="utf-8")


def document(*args: str, out: Path) -> dict:
    assert main([*args, "--json", str(out), "--quiet"]) == 0

    def refuse(name: str) -> float:
        raise AssertionError(f"{name} in JSON")

    return json.loads(out.read_text(), parse_constant=refuse)


@pytest.fixture(scope="module")
def identified(tmp_path_factory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("identified")
    trials = [str(NONE / f"trial_0{i}.csv") for i in (1, 2)]
    found = document("identify", *trials, *RIG_AND_TASK, "--actual", str(NONE / "actual.toml"), "--figures",
                     str(folder / "figures"), "--report", str(folder / "page.html"),
                     out=folder / "out.json")  # fmt: skip
    return found, folder


def test_segment_finds_every_boundary(tmp_path):
    trial = NONE / "trial_01.csv"
    found = document("segment", str(trial), *RIG_AND_TASK, out=tmp_path / "out.json")
    assert found["format"] == "hmmseg.segment/1"
    (only,) = found["trials"]
    assert only["complete"] and "failed" not in only and only["rate"] == pytest.approx(20)
    segments = only["segments"]
    truth = json.loads((NONE / "truth" / "trial_01.json").read_text())["boundaries"]
    assert [s["end"] for s in segments[:-1]] == pytest.approx(truth, abs=0.03)
    assert [a["end"] for a in segments[:-1]] == [b["start"] for b in segments[1:]]
    assert segments[0]["start"] == 0.0 and segments[-1]["end"] == pytest.approx(9.95)
    assert [s["subtask"] for s in segments] == ["pregrasp", "pickup", "carry", "place", "release", "pickup",
                                                "carry", "place", "release"]  # fmt: skip
    for segment in segments[1:]:
        low, high = segment["start_90"]
        assert low < segment["start"] < high and segment["start_sd"] > 0


def test_identify_recovers_the_blocks(identified):
    found, _ = identified
    actual = {  # labels.json of the recordings
        "block1": {"weight": 0.57789, "width": 0.018794, "height": 0.017266},
        "block2": {"weight": 0.52560, "width": 0.027978, "height": 0.012562},
    }
    for name, entries in actual.items():
        for prop, value in entries.items():
            entry = found["properties"][name][prop]
            assert entry["mean"] == pytest.approx(value, rel=0.02 if prop == "weight" else 0.003)
            assert abs(entry["mean"] - value) < 4 * entry["sd"]
            low, high = entry["interval_95"]
            assert low < entry["interval_68"][0] < entry["median"] < entry["interval_68"][1] < high
            assert entry["subtasks"]
        assert 0 < found["properties"][name]["friction"]["lower_bound"] < 1.2
    assert found["properties"]["block1"]["weight"]["subtasks"] == ["carry block1"]
    assert found["properties"]["block1"]["height"]["subtasks"] == ["pickup block2", "place block2"]
    assert found["sampler"]["ess"] > 500 and found["sampler"]["rhat"] < 1.02
    assert found["reasons"] == {} and found["warnings"] == []
    assert found["actual"]["block1"]["width"]["inside_95"]


def test_identify_draws_figures_and_one_self_contained_page(identified):
    found, folder = identified
    drawn = sorted(Path(name).name for name in found["figures"])
    assert drawn == sorted(p.name for p in (folder / "figures").iterdir())
    assert {"corner.png", "estimates.png", "trial_01_segments.png", "trial_02_predictive.png"} <= set(drawn)
    page = (folder / "page.html").read_text()
    assert "block1 weighs" in page and "data:image/png;base64," in page
    assert 'src="http' not in page and 'href="http' not in page


def test_what_a_task_cannot_tell_or_does_not_name_is_said(tmp_path):
    task, folder = tmp_path / "task.toml", tmp_path / "made"
    task.write_text(SINGLE)
    rig = str(NONE / "rig.toml")
    document("simulate", "--task", str(task), "--rig", rig, "--output", str(folder), out=tmp_path / "s.json")
    trial = str(folder / "trial_01.csv")
    found = document("identify", trial, "--task", str(task), "--rig", rig, out=tmp_path / "o.json")
    assert found["trials"][0]["complete"] and found["warnings"] == []
    assert found["properties"]["block1"]["height"] is None and found["reasons"]["block1.height"]
    assert found["properties"]["block1"]["weight"]["mean"] == pytest.approx(0.343, rel=0.03)
    task, trial = tmp_path / "task.toml", tmp_path / "trial.csv"
    task.write_text(SINGLE)  # but the recorded block comes down from another, 12.5 mm
    cut = pd.read_csv(NONE / "trial_01.csv")
    cut[cut.t < 5.5].to_csv(trial, index=False)
    found = document("identify", str(trial), "--task", str(task), "--rig", str(NONE / "rig.toml"),
                     out=tmp_path / "o.json")  # fmt: skip
    assert found["properties"]["block1"]["weight"]["mean"] == pytest.approx(0.57789, rel=0.03)
    (warning,) = found["warnings"]
    assert warning.startswith("block1 was lowered by 12.5 mm")


def test_sums_stand_where_their_terms_do_not(tmp_path):
    true = {"a": (0.4, 0.04, 0.03), "b": (0.9, 0.05, 0.025), "c": (1.4, 0.06, 0.04)}
    units = {"weight": "N", "width": "m", "height": "m"}
    entries = ((o, *entry) for o, own in true.items() for entry in zip(units.items(), own, strict=True))
    actual, tower, pushed = tmp_path / "actual.toml", tmp_path / "tower.toml", tmp_path / "pushed.toml"
    actual.write_text("".join(f'[{o}.{p}]\nunit = "{unit}"\nvalue = {v}\n' for o, (p, unit), v in entries))
    stands = "".join(f'[objects.{o}]\non = "{on}"\n' for o, on in (("a", "b"), ("b", "c"), ("c", "ground")))
    moves = [f'[[moves]]\nobject = "{o}"\nto = "{to}"\n'
             for o, to in (("a", "ground"), ("b", "a"), ("c", "b"))]  # fmt: skip
    tower.write_text(stands + "".join(moves))
    pushed.write_text(stands + moves[0] + '[[moves]]\nobject = "b"\nto = "c"\nslide = true\n')
    found = {}
    for task in (tower, pushed):
        args = ("--task", str(task), "--rig", str(NONE / "rig.toml"))
        made = tmp_path / task.stem
        simulate = ["simulate", *args, "--properties", str(actual), "--output", str(made), "--quiet"]
        assert main(simulate) == 0
        found[task.stem] = document("identify", str(made / "trial_01.csv"), *args,
                                    out=tmp_path / f"{task.stem}.json")  # fmt: skip
    sums = {tuple(one["of"]): one for one in found["tower"]["combinations"]}
    assert sums.keys() == {("b.height", "c.height"), ("a.height", "b.height")}
    for names, one in sums.items():
        assert all(found["tower"]["properties"][name[0]]["height"] is None for name in names)
        assert "only together" in found["tower"]["reasons"][names[0]]
        true_sum = sum(true[name[0]][2] for name in names)
        assert abs(one["mean"] - true_sum) < 4 * one["sd"] < 0.001
    shown = {(row["block"], row["property"]): row["estimate"] for row in property_rows(found["tower"])}
    assert shown["b + c", "height"].startswith("6.5") or shown["b + c", "height"].startswith("6.4")
    assert found["pushed"]["trials"][0]["complete"] and found["pushed"]["properties"]["b"]["weight"] is None
    assert found["pushed"]["reasons"]["b.weight"] == "no subtask of this task lifts b"


def test_rigs_without_stiffness_and_the_papers_method_say_what_they_lack(tmp_path):
    trial = str(NONE / "trial_02.csv")
    found = document("identify", trial, *RIG_AND_TASK, "--method", "paper", out=tmp_path / "out.json")
    assert found["method"] == "paper" and found["trials"][0]["log_evidence"] is None
    assert found["properties"]["block1"]["width"]["mean"] < 0.0185  # short by what the pads give
    rig, text = tmp_path / "rig.toml", (NONE / "rig.toml").read_text()
    rig.write_text(re.sub(r"(?m)^(normal|shear)_stiffness.*$", "", text))
    args = (str(NONE / "trial_01.csv"), "--task", str(NONE / "task.toml"), "--rig", str(rig))
    warnings = "; ".join(document("identify", *args, out=tmp_path / "out.json")["warnings"])
    assert "rig.toml states none" in warnings and "normal_stiffness is not finite" in warnings
    assert re.search(r"about \d{4} N/m", warnings) and "inf," not in warnings


@pytest.mark.slow  # `make wheel` runs it as well
def test_demo_runs_on_the_packages_own_recordings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = document("demo", out=tmp_path / "out.json")
    assert found["format"] == "hmmseg.demo/1"
    assert {"corner.png", "report.html"} <= {p.name for p in (tmp_path / "demo").iterdir()}
    for block in found["actual"].values():
        assert all(abs(entry["relative_deviation"]) < 0.02 for entry in block.values())
    pads = found["diagnosis"]["effects"]["fingertip_compliance"]["parameters"]
    for name, true in (("normal_stiffness", 4000.0), ("shear_stiffness", 2500.0)):
        low, high = pads[name]["interval_90"]
        assert low < true < high and high - low < 0.15 * true, name  # what their rig.toml states


def test_plain_tasks_and_block_tasks_are_kept_apart(tmp_path, capsys):
    task = tmp_path / "task.toml"
    task.write_text('sequence = ["approach", "insertion"]\n')
    trial = str(NONE / "trial_01.csv")
    assert main(["identify", trial, "--task", str(task), "--rig", str(NONE / "rig.toml")]) == 2
    assert "no blocks to identify" in capsys.readouterr().err
    assert main(["fit", trial, "--task", str(NONE / "task.toml"), "--model", str(tmp_path / "m.npz")]) == 2
    assert "needs no fitting" in capsys.readouterr().err
    alone = shutil.copy(trial, tmp_path)  # no rig.toml lies beside it
    assert main(["segment", alone, "--task", str(NONE / "task.toml")]) == 2
    assert "--rig" in capsys.readouterr().err


def test_plain_ordered_task_fits_saves_and_segments(tmp_path):
    rng = np.random.default_rng(0)
    task, labels, model = tmp_path / "task.toml", tmp_path / "labels", tmp_path / "model.npz"
    task.write_text('sequence = ["rest", "push", "rest again"]\nchannels = ["f"]\n')
    labels.mkdir()
    edges = []
    for i in range(4):
        a, b = 2 + rng.uniform(), 5 + rng.uniform()
        t = np.arange(0, 8, 0.02)
        force = np.where((t > a) & (t < b), 3.0, 0.0) + 0.1 * rng.normal(size=t.size)
        pd.DataFrame({"t": t, "f": force}).to_csv(tmp_path / f"push_{i}.csv", index=False)
        edges.append((a, b))
        if i < 2:
            (labels / f"push_{i}.json").write_text(json.dumps({"boundaries": [a, b]}))
    trials = [str(tmp_path / f"push_{i}.csv") for i in range(4)]
    fitted = document("fit", *trials[:2], "--task", str(task), "--labels", str(labels), "--model", str(model),
                      out=tmp_path / "fit.json")  # fmt: skip
    assert fitted["labelled"] == ["push_0.csv", "push_1.csv"] and model.exists()
    found = document("segment", *trials[2:], "--task", str(task), "--model", str(model),
                     "--figures", str(tmp_path / "figures"), out=tmp_path / "segment.json")  # fmt: skip
    for trial, (a, b) in zip(found["trials"], edges[2:], strict=True):
        assert [s["end"] for s in trial["segments"][:-1]] == pytest.approx([a, b], abs=0.06)
        assert trial["segments"][0]["object"] is None and trial["segments"][1]["state"] == "push"
        assert math.isfinite(trial["log_evidence"])


@pytest.fixture
def decomposed(tmp_path, capsys, monkeypatch):
    """Run the command on a task's text; returns its document and what people see."""
    monkeypatch.setenv("COLUMNS", "120")

    def run(text: str) -> tuple[dict, str]:
        (tmp_path / "task.toml").write_text(text)
        assert main(["decompose", str(tmp_path / "task.toml"), "--json", str(tmp_path / "out.json")]) == 0
        printed = capsys.readouterr()
        assert printed.err == ""
        return json.loads((tmp_path / "out.json").read_text()), printed.out

    return run


def test_the_papers_equation_1_and_its_document(decomposed):
    document, printed = decomposed(PAPER)
    assert document["equation"].split(",\n      ") == [
        "T = { Pregrasp 1 = (free-motion, {∅})",
        "Pickup 1 = (hold-on-ground 1, {height 2, friction 1})",
        "Carry 1 = (hold-above-ground 1, {weight 1, width 1, friction 1})",
        "Place 1 = (hold-on-ground 1, {height 2, friction 1})",
        "Release 1 = (free-motion, {∅})",
        "Pickup 2 = (hold-on-ground 2, {height 1, friction 2})",
        "Carry 2 = (hold-above-ground 2, {weight 2, width 2, friction 2})",
        "Place 2 = (hold-on-ground 2, {height 1, friction 2})",
        "Release 2 = (free-motion, {∅}) }",
    ]
    assert document["equation"] in printed
    assert "block1: weight in carry block1; " in printed.partition("┏")[0]  # in words first
    (row,) = (line for line in printed.splitlines() if "│ carry block1" in line)
    cells = [cell.strip() for cell in row.split("│")]
    assert cells[3:7] == ["hold-above-ground", "vertical", "horizontal", ""]
    document, _ = decomposed(PAPER)
    assert document["minimal"] == list(range(9))
    assert document["height_equations"] == [{"move": 1, "rise": {"block2": -1}},
                                            {"move": 2, "rise": {"block1": 1}}]  # fmt: skip
    assert (document["reasons"], document["notes"], document["repeat"]) == ({}, [], 1)
    pickup = document["subtasks"][1]
    assert {key: pickup[key] for key in ("index", "subtask", "object", "state", "move", "support")} == {
        "index": 1, "subtask": "pickup", "object": "block1", "state": "hold-on-ground", "move": 1,
        "support": "block2"}  # fmt: skip
    assert pickup["constraints"] == ["block1-block2", "finger1-block1", "finger2-block1"]
    assert [entry["property"] for entry in pickup["properties"] if entry["in_paper"]] == [
        "block2.height", "block1.friction"]  # fmt: skip
    assert pickup["properties"][1] == {
        "property": "block2.height", "signals": ["vertical positions"], "with": [3], "kind": "value",
        "given": [], "condition": None, "in_paper": True}  # fmt: skip
    assert document["properties"]["block1"]["weight"] == {
        "kind": "value", "evidence": [{"subtasks": [2], "signals": ["vertical forces"], "kind": "value",
                                       "given": [], "condition": None}]}  # fmt: skip


def test_names_reasons_and_notes_of_blocks_and_of_a_plain_sequence(decomposed):
    document, printed = decomposed(
        'repeat = "unknown"\n[objects.cup]\non = "ground"\n[objects.lid]\non = "ground"\n'
        '[[moves]]\nobject = "cup"\nto = "ground"\nslide = true\n'
    )
    assert (
        "Slide cup = (sliding-on-ground cup, {friction cup, friction on ground cup})" in document["equation"]
    )
    assert document["properties"]["lid"]["weight"] is None
    assert document["reasons"]["lid.weight"] == "no recorded move grips lid"
    assert document["properties"]["cup"]["friction_on_ground"]["kind"] == "value"
    assert document["repeat"] == "unknown" and "one round is decomposed" in printed
    assert "lid.weight: no recorded move grips lid" in printed
    document, printed = decomposed('sequence = ["approach", "mating"]')
    assert document["equation"] == "T = { approach = (approach, {∅}),\n      mating = (mating, {∅}) }"
    assert document["properties"] == {}
    assert document["notes"] == ["a plain ordered task has no block physics: no properties"]
    assert "height_equations" not in document and "approach" in printed
