"""decompose, identify, inspect and new, end to end; actual.toml and what contradicts it."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import file_writers
import numpy as np
import pandas as pd
import pytest
from fault_scene import CARTESIAN
from refusals import refused

from estimation.report import compare, disagreements, parse_actual, property_rows, read_actual
from experiments.wrist_scene import Setup, performances, wrist_recording
from hmmseg.example import example_folder
from hmmseg.hand.inspect import inspect, propose
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.table import make_table
from hmmseg.io.task import read_task
from hmmseg_cli.main import main

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
NONE = RECORDINGS / "none_1"
RIG_AND_TASK = ("--task", str(NONE / "task.toml"), "--rig", str(NONE / "rig.toml"))
SINGLE = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'
PAPER = (example_folder() / "task.toml").read_text(encoding="utf-8")


def document(*args: str, out: Path) -> dict:
    assert main([*args, "--json", str(out), "--quiet"]) == 0
    return json.loads(out.read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def identified(tmp_path_factory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("identified")
    trials = [str(NONE / f"trial_0{i}.csv") for i in (1, 2)]
    found = document("identify", *trials, *RIG_AND_TASK, "--actual", str(NONE / "actual.toml"), "--figures",
                     str(folder / "figures"), "--report", str(folder / "page.html"),
                     out=folder / "out.json")  # fmt: skip
    return found, folder


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
    segments = found["trials"][0]["segments"]
    assert [a["end"] for a in segments[:-1]] == [b["start"] for b in segments[1:]]
    for segment in segments[1:]:
        low, high = segment["start_90"]
        assert low < segment["start"] < high and segment["start_sd"] > 0


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
    trial, cut = tmp_path / "trial.csv", pd.read_csv(NONE / "trial_01.csv")
    cut[cut.t < 5.5].to_csv(trial, index=False)  # the block comes down from another, 12.5 mm
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
    assert document["minimal"] == list(range(9))
    assert document["height_equations"] == [{"move": 1, "rise": {"block2": -1}},
                                            {"move": 2, "rise": {"block1": 1}}]  # fmt: skip
    assert (document["reasons"], document["notes"], document["repeat"]) == ({}, [], 1)
    states, pickup = document["subtasks"], document["subtasks"][1]
    assert [s["support"] for s in states] == [None, "block2", None, "ground", None, "ground", None, "block1",
                                              None]  # fmt: skip
    assert [s["move"] for s in states] == [1] * 5 + [2] * 4
    assert states[2]["constraints"] == ["finger1-block1", "finger2-block1"] and states[4]["constraints"] == []
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
    slide = "Slide cup = (sliding-on-ground cup, {friction cup, friction on ground cup})"
    assert slide in document["equation"]
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


GOOD = {"block1": {"weight": {"unit": "N", "value": 0.343, "sd": 0.0005}}}
FOUND = {"block1": {"weight": {"mean": 0.4639, "sd": 0.0015, "interval_95": [0.461, 0.467]},
                    "width": {"mean": 0.036105, "sd": 1.6e-5, "interval_95": [0.03607, 0.03614]},
                    "height": None, "friction": {"lower_bound": 0.5}}}  # fmt: skip


def test_a_file_gives_values_with_deviations_and_a_missing_one_is_named(tmp_path):
    path = tmp_path / "actual.toml"
    path.write_text(
        '[block1.weight]\nunit = "N"\nvalue = 0.343\nsd = 0.0005\n'
        '[block2.height]\nunit = "m"\nvalue = 1\n[block2.friction]\nunit = "1"\nvalue = 1.2\nsd = 0.1\n'
    )
    assert read_actual(path, ["block1", "block2"]) == {"block1": {"weight": (0.343, 0.0005)},
                                                       "block2": {"height": (1.0, 0.0),
                                                                  "friction": (1.2, 0.1)}}  # fmt: skip
    refused(r"absent\.toml: no such file", read_actual, tmp_path / "absent.toml", ["block1"])


@pytest.mark.parametrize("table, message", [
    *(({"block1": {"weight": entry}}, message) for entry, message in [
        ({"unit": "kg", "value": 1.0}, "key block1.weight.unit: found 'kg'; expected \"N\""),
        ({"value": 1.0}, "key block1.weight.unit: found None"),
        ({"unit": "N"}, "key block1.weight.value: found None; expected a number > 0"),
        ({"unit": "N", "value": 0.0}, "key block1.weight.value: found 0.0; expected a number > 0"),
        ({"unit": "N", "value": True}, "key block1.weight.value: found True"),
        ({"unit": "N", "value": float("nan")}, "key block1.weight.value: found nan"),
        ({"unit": "N", "value": 1.0, "sd": -0.1}, "key block1.weight.sd: found -0.1; expected a number >= 0"),
        ({"unit": "N", "value": 1.0, "sdd": 0.1}, "key block1.weight.sdd: unknown key; expected one of sd, "),
        (0.3, "key block1.weight: found 0.3; expected a table with unit, value and sd"),
    ]),
    ({"blok1": GOOD["block1"]}, "key blok1: is not an object of the task; expected one of block1, block2 "
                                "(did you mean block1?)"),
    ({"block1": {"wieght": {}}}, "key block1.wieght: unknown property; expected one of friction, height, "
                                 "weight, width (did you mean weight?)"),
    ({"block1": 3}, "key block1: found 3; expected tables [block1.PROPERTY]")])  # fmt: skip
def test_refused_entries_and_tables(table, message):
    refused(re.escape(message), parse_actual, table, ["block1", "block2"])


def test_what_the_recordings_contradict_is_remarked_on():
    measured = {"block1": {"weight": (0.5126, 0.0005), "width": (0.0361, 1e-4), "height": (0.026, 1e-4)}}
    compared = compare(FOUND, measured)
    assert compared["block1"]["weight"]["disagrees"] and not compared["block1"]["width"]["disagrees"]
    assert compared["block1"]["height"] == {"value": 0.026, "sd": 1e-4}
    (line,) = disagreements(FOUND, compared)
    assert line.startswith("block1.weight: the recordings say 0.4639 ± 0.0015 N, 9.5 % below")
    assert not compare(FOUND, measured, smallest=0.2)["block1"]["weight"]["disagrees"]  # [tolerance] property
    compared = compare(FOUND, {"block1": {"friction": (0.3, 0.02)}})
    assert disagreements(FOUND, compared)[0].startswith("block1.friction: measured as 0.300 ± 0.020, but")
    assert disagreements(FOUND, compare(FOUND, {"block1": {"friction": (0.45, 0.02)}})) == []


T = np.arange(0, 2, 0.02)
WRIST = {"t": T, "width": 0.06 - 0.03 * (T > 1), "ee_y": 0.1 * T, "ee_z": 0.2 - 0.05 * T,
         **{f"{letter}{axis}": np.sin(T) for letter in "FT" for axis in "xyz"}}  # fmt: skip
OTHERS = {"t": ("stamp", 1e9), "x1": ("finger_left_x_mm", 1e3), "y1": ("finger_left_z_mm", 1e3),
          "vx1": ("finger_left_vx", 1.0), "vy1": ("finger_left_vz", 1.0), "fx1": ("LeftForceX [mN]", 1e3),
          "fy1": ("LeftForceZ [mN]", 1e3), "x2": ("finger_right_x", 1e3), "y2": ("finger_right_z", 1e3),
          "vx2": ("finger_right_vx", 1.0), "vy2": ("finger_right_vz", 1.0), "fx2": ("RightForceX [mN]", -1e3),
          "fy2": ("RightForceZ [mN]", -1e3)}  # fmt: skip
FINGERS = {name: CARTESIAN[name] for name in ("t", "x1", "y1", "fx1", "fy1", "x2", "y2", "fx2", "fy2")}
HZ = 20
SIDES = {"1": "links", "2": "rechts"}
FINGER_NAMES = {name: (f"Finger_{SIDES[name[1]]}_{name[0]}_mm", 1e3) if len(name) == 2
                else (f"Kraft_{SIDES[name[2]]}_{name[1]}_N", 1.0) for name in FINGERS
                if name != "t"}  # fmt: skip
WRIST_NAMES = {"width": ("Oeffnung_mm", 1e3), "ee_y": ("TCP_y_mm", 1e3), "ee_z": ("TCP_z_mm", 1e3),
               **{f"F{axis}": (f"F{axis}_N", 1.0) for axis in "xyz"}}  # fmt: skip
FINGER_FILES = {
    "MCAP": lambda f: file_writers.mcap_of(f / "a.mcap", file_writers.finger_topics(FINGERS)),
    "ROS 1 bag": lambda f: file_writers.bag_of(f / "a.bag", file_writers.finger_topics(FINGERS)),
    "ROS 2 bag": lambda f: file_writers.bag_of(f / "a", file_writers.finger_topics(FINGERS)),
    "LeRobot v2": lambda f: lerobot(f / "a", 2, HZ, file_writers.finger_columns(FINGERS)),
    "LeRobot v3": lambda f: lerobot(f / "a", 3, HZ, file_writers.finger_columns(FINGERS)),
    "robomimic": lambda f: (
        f"{file_writers.robomimic_of(f / 'a.hdf5', HZ, [file_writers.finger_vectors(FINGERS)] * 2)}#demo_1"
    ),
    "CSV of a spreadsheet": lambda f: written(f / "a.csv", file_writers.german(FINGERS, FINGER_NAMES)),
}
WRIST_FILES = {
    "MCAP": lambda f, c: file_writers.mcap_of(f / "a.mcap", file_writers.wrist_topics(c)),
    "ROS 1 bag": lambda f, c: file_writers.bag_of(f / "a.bag", file_writers.wrist_topics(c)),
    "ROS 2 bag": lambda f, c: file_writers.bag_of(f / "a", file_writers.wrist_topics(c)),
    "LeRobot v3": lambda f, c: lerobot(f / "a", 3, 50, {k: v for k, v in c.items() if k != "t"}),
    "CSV of a spreadsheet": lambda f, c: written(f / "a.csv", file_writers.german(c, WRIST_NAMES)),
    "robomimic": lambda f, c: (
        f"{file_writers.robomimic_of(f / 'a.hdf5', 50, [file_writers.wrist_vectors(c)])}#demo_0"
    ),
}


def test_times_and_rates_that_contradict_are_told(tmp_path, capsys):
    frame = pd.DataFrame(CARTESIAN)
    pd.concat([frame, frame]).to_csv(tmp_path / "two.csv", index=False)
    assert main(["inspect", str(tmp_path / "two.csv")]) == 0
    said = capsys.readouterr()
    assert "column t: 0 after" in said.err and "the times are not" in said.out and "next:" not in said.out
    rig = read_rig(NONE / "rig.toml").model_copy(update={"rate": 50.0})
    trial = read_trial(NONE / "trial_01.csv", rig)
    assert any("is sampled at 20 Hz, but rate = 50 in rig.toml" in each for each in trial.warnings)


def test_another_labs_file_is_read_with_what_inspect_proposes(tmp_path, capsys):
    ours = dict(CARTESIAN)
    frame = pd.DataFrame({name: ours[channel] * factor for channel, (name, factor) in OTHERS.items()})
    frame["stamp"] = frame["stamp"].round().astype(np.int64)
    frame.to_csv(tmp_path / "a.csv", index=False, sep=";", decimal=",")
    (tmp_path / "rig.toml").write_text("gravity = 9.81\n")
    assert main(["inspect", str(tmp_path / "a.csv"), "--write", str(tmp_path / "rig.toml"), "--json",
                 "-"]) == 0  # fmt: skip
    document = json.loads(capsys.readouterr().out)
    (file,) = document["files"]
    assert file["mapping"]["t"] == {"from": "stamp", "unit": "ns"}
    assert file["mapping"]["x1"] == {"from": "finger_left_x_mm", "unit": "mm"}
    assert file["mapping"]["x2"] == {"from": "finger_right_x", "unit": "mm"}  # by how far it travels
    assert file["mapping"]["fx2"] == {"from": "RightForceX [mN]", "unit": "mN", "sign": -1}
    assert any("push the same way" in line for line in file["findings"])
    assert any("fy2 pulls down" in line for line in file["findings"])  # told, and left to a person
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.gravity == 9.81
    rig = rig.model_copy(update={"columns": {
        **rig.columns, "fy2": rig.columns["fy2"].model_copy(update={"sign": -1.0})}})  # fmt: skip
    trial = read_trial(tmp_path / "a.csv", rig)
    for name, values in trial.channels.items():
        np.testing.assert_allclose(values, ours[name], atol=1e-9, err_msg=name)


def test_what_is_in_a_file_a_log_and_a_file_of_several(tmp_path, capsys):
    t = np.delete(np.arange(100) * 0.02, [40, 41, 42, 43, 44])
    force = np.sin(t)
    force[3] = np.nan
    table = pd.DataFrame({"t": t, "force [N]": force, "note": "x", "left": np.nan})
    table.to_csv(tmp_path / "a.csv", index=False)
    found = inspect(tmp_path / "a.csv")
    assert (found.samples, found.rate, found.end) == (95, pytest.approx(50.0), pytest.approx(1.98))
    assert found.gaps == ((pytest.approx(0.78), pytest.approx(0.9)),)
    _, channel, note, left = found.channels
    assert left.rate is None and left.missing == 95
    assert (channel.unit, channel.missing, note.text, found.mapping) == ("N", 1, True, {})
    assert channel.maximum == pytest.approx(np.nanmax(force))
    log = inspect(file_writers.mcap_of(tmp_path / "a.mcap", file_writers.planted()))
    rates = {channel.name: channel.rate for channel in log.channels}
    assert rates["/wrench.wrench.force.x"] == pytest.approx(100.0)
    assert rates["/pose.pose.position.z"] == pytest.approx(20.0)
    path = file_writers.write_robomimic(tmp_path / "demos.hdf5")
    assert main(["inspect", str(path)]) == 0
    assert "the first of 2 recordings (demo_0 ... demo_1)" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("case", ["none_1", "paper_blocks"])
def test_nothing_is_proposed_where_nothing_is_needed(case):
    found = inspect(NONE.parent / case / "trial_01.csv")
    assert (found.mapping, found.remarks) == ({}, ())


@pytest.mark.parametrize(("names", "expected"), [
    (["time", "L_pos_x", "L_pos_y", "L_fx", "L_fy", "R_pos_x", "R_pos_y", "R_fx", "R_fy"],
     {"t": "time", "x1": "L_pos_x", "y1": "L_pos_y", "fx1": "L_fx", "fy1": "L_fy", "x2": "R_pos_x",
      "y2": "R_pos_y", "fx2": "R_fx", "fy2": "R_fy"}),
    (["timestamp", "finger1.tip.x", "finger1.tip.z", "finger1.force.x", "finger1.force.z",
      "finger2.tip.x", "finger2.tip.z", "finger2.force.x", "finger2.force.z", "finger1.torque.x"],
     {"t": "timestamp", "x1": "finger1.tip.x", "y1": "finger1.tip.z", "fx1": "finger1.force.x",
      "fy1": "finger1.force.z", "x2": "finger2.tip.x", "y2": "finger2.tip.z", "fx2": "finger2.force.x",
      "fy2": "finger2.force.z"}),
    (["t", "right_joint_1", "right_joint_2", "left_joint_1", "left_joint_2", "F1x", "F1y", "F2x", "F2y"],
     {"q21": "right_joint_1", "q22": "right_joint_2", "q11": "left_joint_1", "q12": "left_joint_2",
      "fx1": "F1x", "fy1": "F1y", "fx2": "F2x", "fy2": "F2y"}),
    (["t", "joint1_1", "joint1_2", "joint2_1", "joint2_2", "F1x", "F1y", "F2x", "F2y"],
     {"q11": "joint1_1", "q12": "joint1_2", "q21": "joint2_1", "q22": "joint2_2", "fx1": "F1x",
      "fy1": "F1y", "fx2": "F2x", "fy2": "F2y"}),
    (["t", "temperature", "pressure"], {})])  # fmt: skip
def test_names_taken_apart(names, expected):
    table = make_table("a", {name: np.zeros(9) for name in names})
    assert {ours: fields["from"] for ours, fields in propose(table).items()} == expected


def test_what_to_do_next_is_said_and_no_line_to_copy_is_wrapped(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    assert main(["inspect", str(NONE / "trial_01.csv")]) == 0
    assert "all columns understood; next: hmmseg segment" in capsys.readouterr().out
    ours = dict(CARTESIAN)
    frame = pd.DataFrame({OTHERS[name][0]: values for name, values in ours.items()})
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert main(["inspect", str(tmp_path / "a.csv")]) == 0
    text = capsys.readouterr().out
    (start,) = [i for i, line in enumerate(text.split("\n")) if line == "[columns]"]
    toml = "\n".join(text.split("\n")[start:]).split("\n\n")[0]
    assert tomllib.loads(toml)["columns"]["t"]["from"] == "stamp"
    assert f"next: hmmseg inspect {tmp_path / 'a.csv'} --write rig.toml" in text


@pytest.mark.parametrize("text", ["", "t,x\n", "# nothing\n"])
def test_an_empty_file_is_refused(tmp_path, capsys, text):
    (tmp_path / "a.csv").write_text(text)
    assert main(["inspect", str(tmp_path / "a.csv")]) == 2
    line = f"{tmp_path}/a.csv: is empty; expected a header row and a row for every sample\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(("rig", "line"), [
    ("[columns]\nx1 = 'a'\n", "--write .*rig.toml: already has .columns.; expected a rig without it"),
    ("rate = -1", "rig.toml: key rate: "),
    ("rate = ", "rig.toml: not valid TOML")])  # fmt: skip
def test_a_rig_that_cannot_take_the_mapping_stays_as_it_was(tmp_path, capsys, rig, line):
    ours = dict(CARTESIAN)
    pd.DataFrame({"time": ours.pop("t"), **ours}).to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "rig.toml").write_text(rig)
    assert main(["inspect", str(tmp_path / "a.csv"), "--write", str(tmp_path / "rig.toml"), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and re.search(line, error) and (tmp_path / "rig.toml").read_text() == rig


@pytest.mark.parametrize("hand", ["cartesian", "jointed", "gripper", "none"])
def test_new_lays_out_files_that_read(tmp_path, hand):
    assert main(["new", str(tmp_path / "lab"), "--hand", hand, "--quiet"]) == 0
    rig, task = read_rig(tmp_path / "lab/rig.toml"), read_task(tmp_path / "lab/task.toml")
    assert (rig.jointed, rig.gripper is not None) == (hand == "jointed", hand == "gripper")
    assert hasattr(task, "sequence") == (hand == "none")


def test_a_gripper_laid_out_takes_the_names_of_a_log(tmp_path, capsys):
    """`new`, then `inspect --write`: the file's names in the places of those laid out, all else as it was."""
    rig = tmp_path / "lab/rig.toml"
    log = file_writers.mcap_of(tmp_path / "a.mcap", file_writers.wrist_topics(WRIST))
    assert main(["new", str(rig.parent), "--hand", "gripper", "--quiet"]) == 0
    before = rig.read_text()
    assert main(["inspect", str(log), "--write", str(rig), "--quiet"]) == 0
    gripper = read_rig(rig).gripper
    assert gripper.position["z"] == "/franka/ee_pose.pose.position.z"
    assert gripper.opening[1] == "/franka_gripper/joint_states.position.panda_finger_joint2"
    assert gripper.wrench[5] == "/ft_sensor/wrench.wrench.torque.z"
    kept = [line for line in rig.read_text().split("\n") if "/" not in line.split(" = ")[-1]]
    assert set(kept) <= {*before.split("\n"), 'closing = "y"  # the axis along which the pads close'}
    assert main(["inspect", str(log), "--write", str(rig), "--quiet"]) == 2  # they are somebody's now
    assert "already has [gripper]; expected a rig without it" in capsys.readouterr().err


def test_new_fills_in_a_rig_never_hangs_and_never_writes_over(tmp_path, capsys):
    command = [Path(sys.executable).with_name("hmmseg"), "new", "lab"]
    for stdin in (subprocess.DEVNULL, subprocess.PIPE):
        done = subprocess.run(command, cwd=tmp_path, stdin=stdin, capture_output=True, timeout=60,
                              check=False)  # fmt: skip
        text = done.stderr.decode()
        if stdin == subprocess.DEVNULL:
            assert (done.returncode, sorted(os.listdir(tmp_path / "lab"))) == (0, ["rig.toml", "task.toml"])
    assert done.returncode == 2
    assert text == "lab/rig.toml: is there already and would be written over; expected another folder\n"
    table = pd.read_csv(NONE / "trial_01.csv")
    table.to_csv(tmp_path / "jointed.csv", index=False)
    assert main(["new", str(tmp_path / "one"), "--from", str(tmp_path / "jointed.csv")]) == 0
    text = (tmp_path / "one/rig.toml").read_text()
    assert "rate = 20.0" in text and "[fingers.1]" in text and "hmmseg segment" in capsys.readouterr().out
    assert main(["new", str(tmp_path / "one"), "--from", str(tmp_path / "jointed.csv")]) == 2


def test_new_lays_out_the_map_of_a_robot(tmp_path, capsys):
    from simgap.simulators.mjcf.map import Map

    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body><joint name="elbow" axis="0 1 0"/><geom size=".1"/></body></worldbody>'
        '<actuator><motor name="m1" joint="elbow"/></actuator></mujoco>'
    )
    (tmp_path / "log.csv").write_text(
        "ros_stamp,elbow_deg,elbow_vel,elbow_cmd,tau_elbow,room\n"
        + "".join(f"{1700000000000000000 + k * 10000000},1,2,3,5,4\n" for k in range(20))
    )
    given = ["--mjcf", str(tmp_path / "robot.xml"), "--from", str(tmp_path / "log.csv")]
    assert main(["new", str(tmp_path), *given]) == 0
    assert "columns left to you: room" in " ".join(capsys.readouterr().out.split())
    found = Map.from_toml(tmp_path / "map.toml")
    assert {n: (m.thing, m.kind) for n, m in found.columns.items()} == {
        "elbow_deg": ("joint", "position"), "elbow_vel": ("joint", "velocity"),
        "elbow_cmd": ("actuator", "command"), "tau_elbow": ("actuator", "force")}  # fmt: skip
    assert (found.clock.column, found.clock.size) == ("ros_stamp", 1e-9)
    assert main(["new", str(tmp_path / "other"), "--model", str(tmp_path / "robot.xml")]) == 2


def lerobot(folder, version, rate, columns):
    states = np.stack(list(columns.values()), axis=1)
    file_writers.lerobot_of(folder, version, rate, list(columns), [states, states],
                            [np.zeros((len(states), 2))] * 2)  # fmt: skip
    return f"{folder}#1"


def written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", FINGER_FILES)
def test_two_fingers_read_as_recorded(tmp_path, kind):
    file, rig = FINGER_FILES[kind](tmp_path), tmp_path / "rig.toml"
    assert main(["inspect", str(file), "--write", str(rig), "--quiet"]) == 0
    trial = read_trial(file, read_rig(rig))
    assert trial.warnings == ()
    at = np.searchsorted(trial.t, FINGERS["t"] - FINGERS["t"][0] - 1e-4)  # poses are logged twice as often
    close = 1e-6 if "LeRobot" in kind else 2e-9  # single precision
    np.testing.assert_allclose(trial.t[at], FINGERS["t"] - FINGERS["t"][0], atol=1e-6)
    for name in FINGERS.keys() - {"t"}:
        np.testing.assert_allclose(trial.channels[name][at], FINGERS[name], atol=close, rtol=1e-6)


@pytest.fixture(scope="module")
def wrist():
    setup = Setup(axes=("x", "y", "z"))
    columns = wrist_recording(performances(1)[0], setup)
    names = {"gap": "width", "py": "ee_y", "pz": "ee_z", "Fx": "Fx", "Fy": "Fy", "Fz": "Fz"}
    out = {"t": columns["t"]} | {theirs: columns[ours] for ours, theirs in names.items()}
    return out | {f"T{axis}": 0 * columns["t"] for axis in "xyz"}


@pytest.mark.parametrize("kind", WRIST_FILES)
def test_a_wrist_reads_as_recorded(tmp_path, wrist, kind, capsys):
    plain = parse_rig({"gripper": {"position": {"y": "ee_y", "z": "ee_z"}, "opening": "width",
                                   "wrench": ["Fx", "Fy", "Fz"]}})  # fmt: skip
    expected = read_trial(wrist, plain)
    file, rig = WRIST_FILES[kind](tmp_path, wrist), tmp_path / "rig.toml"
    assert main(["inspect", str(file), "--write", str(rig), "--quiet"]) == 0
    if kind == "robomimic":  # its second finger counts the other way, and the line says so
        task = written(tmp_path / "task.toml",
                       b'[objects.a]\non = "ground"\n[[moves]]\nobject = "a"\nto = "ground"\n')  # fmt: skip
        assert main(["segment", str(file), "--task", str(task), "--rig", str(rig)]) == 2
        line = capsys.readouterr().err
        entry = line.split("expected ")[1].split(" under [columns]")[0]
        rig.write_text(f"{rig.read_text()}\n[columns]\n{entry}\n")
    trial = read_trial(file, read_rig(rig))
    assert trial.warnings == ()
    for name in ("x1", "y1", "fy1", "x2", "y2", "fy2"):
        np.testing.assert_allclose(trial.channels[name], expected.channels[name],
                                   atol=1e-3 * (name[0] == "f") + 2e-5)  # fmt: skip
