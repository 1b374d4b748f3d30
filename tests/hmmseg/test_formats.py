"""Every kind of file against the recording planted in it, and labelled copies read back."""

import json
import os
import re
import sqlite3
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from file_writers import (
    FAST,
    SLOW,
    START,
    Topic,
    bag_of,
    force,
    height,
    joint,
    mcap_of,
    planted,
    robomimic_of,
    write_lerobot,
    write_robomimic,  # fmt: skip
)
from mcap.reader import make_reader
from refusals import refused

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import kind_of, parts_of, read_table, split_part
from hmmseg.io.formats.logs import interpolated
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Span
from hmmseg_cli.labels import ADDED, label, lerobot_files, write_table
from hmmseg_cli.labels import write_mcap as write_topic
from hmmseg_cli.main import main

TOPICS = parse_rig({"topics": {
    "push": {"from": "/wrench.wrench.force.x", "sign": -1},
    "angle": {"from": "/joints.position.b", "unit": "rad"},
    "height": "/pose.pose.position.z"}})  # fmt: skip
LOGGED = SequenceTask(("a", "b"), channels=("push", "angle", "height"))
LOGS = {"mcap": lambda folder: mcap_of(folder / "log.mcap", planted()),
        "ROS 1 bag": lambda folder: bag_of(folder / "log.bag", planted()),
        "ROS 2 bag": lambda folder: bag_of(folder / "log", planted())}  # fmt: skip
NONE = Path(__file__).resolve().parents[2] / "recordings/none_1"
HAND = ["--task", str(NONE / "task.toml"), "--rig", str(NONE / "rig.toml"), "--method", "qualitative"]


@pytest.mark.parametrize("kind", LOGS)
def test_logs_are_joined_on_the_fastest_wanted_clock(tmp_path, kind):
    trial = read_trial(LOGS[kind](tmp_path), TOPICS, LOGGED)
    np.testing.assert_allclose(trial.t, FAST * 1e-9, atol=1e-9)
    assert trial.origin == START + FAST[0]  # stamps of the headers, not times of logging
    np.testing.assert_allclose(trial.channels["push"], -force(FAST), rtol=1e-12)
    inside = SLOW[-1] >= FAST
    for name, course in (("angle", joint), ("height", height)):
        np.testing.assert_allclose(trial.channels[name][inside], course(FAST[inside]), rtol=1e-9)
        assert np.isnan(trial.channels[name][~inside]).all()
        np.testing.assert_array_equal(trial.interpolated[name], inside & ~np.isin(FAST, SLOW))
    assert "push" not in trial.interpolated


def test_logs_without_stamps_with_gaps_and_of_two_publishers_keep_their_times(tmp_path):
    rig = parse_rig({"topics": {"f": "/wrench.wrench.force.x", "w": "/opening.data",
                                "z": "/pose.pose.position.z"}})  # fmt: skip
    trial = read_trial(mcap_of(tmp_path / "a.mcap", planted()), rig,
                       SequenceTask(("a",), channels=("f", "w", "z")))  # fmt: skip
    assert trial.origin == START + 300_000
    np.testing.assert_allclose(trial.channels["w"], 0.06)
    path = mcap_of(tmp_path / "a.mcap", planted((500_000_000, 900_000_000)))
    trial = read_trial(path, TOPICS, LOGGED)
    missing = np.isnan(trial.channels["height"])
    low, high = SLOW[SLOW < 500_000_000][-1], SLOW[SLOW >= 900_000_000][0]
    np.testing.assert_array_equal(missing, ((low < FAST) & (high > FAST)) | (SLOW[-1] < FAST))
    fast, slow = np.arange(100) * 20_000_000, np.arange(50) * 40_000_000 + 3_000_000
    arm = {"position": {"a": joint(fast)}, "velocity": {"a": 0.0 * fast}}
    finger = {"position": {"f": height(slow)}, "velocity": {"f": np.nan * slow}}
    topics = [Topic("/joints", "sensor_msgs/msg/JointState", START + ns, v)
              for ns, v in ((fast, arm), (slow, finger))]  # fmt: skip
    rig = parse_rig({"topics": {"a": "/joints.position.a", "f": "/joints.position.f"}})
    path = mcap_of(tmp_path / "a.mcap", topics)
    trial = read_trial(path, rig, SequenceTask(("a",), channels=("a", "f")))
    np.testing.assert_allclose(trial.channels["a"], joint(fast), rtol=1e-12)
    inside = np.isfinite(trial.channels["f"])
    assert inside.sum() == 98  # all but the one before the first message and the one after the last
    np.testing.assert_allclose(trial.channels["f"][inside], height(fast[inside]), rtol=1e-9)
    rates = read_table(path).rates
    assert (rates["/joints.position.a"], rates["/joints.position.f"]) == (50.0, 25.0)


@pytest.mark.parametrize("how", ["another clock", "a clock that was set"])
def test_two_clocks_are_noticed(tmp_path, how):
    stamps = START + FAST
    late = stamps - 40_000_000_000 * ((FAST[90] < FAST) if how != "another clock" else 1)
    value = {"force": np.stack([force(FAST)] * 3, axis=1)}
    topics = [Topic("/a", "geometry_msgs/msg/WrenchStamped", stamps, value, stamps=stamps),
              Topic("/b", "geometry_msgs/msg/WrenchStamped", stamps, value, stamps=late)]  # fmt: skip
    rig = parse_rig({"topics": {"a": "/a.wrench.force.x", "b": "/b.wrench.force.x"}})
    path = mcap_of(tmp_path / "a.mcap", topics)
    trial = read_trial(path, rig, SequenceTask(("a",), channels=("a", "b")))
    np.testing.assert_allclose(trial.channels["b"], force(FAST), rtol=1e-12)
    assert "times of logging are used" in trial.warnings[0] or "latter are used" in trial.warnings[0]
    one = parse_rig({"topics": {"a": "/a.wrench.force.x"}})
    assert read_trial(path, one, SequenceTask(("a",), channels=("a",))).warnings == ()


def test_what_a_bag_lacks_is_listed_and_the_rest_is_read(tmp_path):
    folder = bag_of(tmp_path / "log", planted())
    with sqlite3.connect(next(folder.glob("*.db3"))) as base:
        base.execute("UPDATE topics SET type = 'lab_msgs/msg/Motor' WHERE name = '/opening'")
    line = "topic /opening cannot be decoded (the bag does not define its type lab_msgs/msg/Motor)"
    assert line in "".join(read_table(folder).notes)
    assert read_trial(folder, TOPICS, LOGGED).warnings == ()
    rig = parse_rig({"topics": {"w": "/opening.data"}})
    refused(r"log: topic /opening: cannot be decoded \(the bag does not define", read_trial, folder, rig,
            SequenceTask(("a",), channels=("w",)))  # fmt: skip
    (folder / "metadata.yaml").unlink()
    trial = read_trial(folder, TOPICS, LOGGED)
    np.testing.assert_allclose(trial.channels["push"], -force(FAST), rtol=1e-12)
    assert "has no metadata.yaml: the recording was not finished" in trial.warnings[0]
    rig = parse_rig({"topics": {"f": "/wrench.wrench.force.xx"}})
    refused(r"column /wrench.wrench.force.xx: missing, but the rig maps f to it", read_trial,
            mcap_of(tmp_path / "a.mcap", planted()), rig, SequenceTask(("a",), channels=("f",)))  # fmt: skip


def test_columns_of_other_lengths_are_read_apart(tmp_path):
    steps = np.arange(50.0)
    path = robomimic_of(tmp_path / "a.hdf5", 20,
                        [{"states": np.stack([steps, -steps], 1), "actions": steps[1:]}])  # fmt: skip
    for name, count in (("actions", 49), ("states[1]", 50)):
        trial = read_trial(path, task=SequenceTask(("a",), channels=(name,)))
        np.testing.assert_allclose(trial.t, np.arange(count) / 20)
    assert {name: len(values) for name, values in read_table(path).columns.items()} == {
        "t": 50, "states[0]": 50, "states[1]": 50, "actions": 49}  # fmt: skip
    line = "column actions: has 49 rows; expected 50 as in the others"
    refused(line, read_trial, path, task=SequenceTask(("a",)))


@pytest.mark.parametrize(("size", "line"), [
    (1e9, "sampled at 1e-07 Hz if it is in s: it looks like ns; expected t = .*unit = \"ns\""),
    (1e6, "sampled at 0.0001 Hz if it is in s: it looks like us"), (1.0, None)])  # fmt: skip
def test_stamps_since_1970_in_another_unit_are_refused_in_any_recording(tmp_path, size, line):
    t = ((START * 1e-9 + np.arange(40) * 0.01) * size).round(2)
    table = pd.DataFrame({"t": t.astype(np.int64) if size > 1 else t, "x": np.arange(40.0)})
    table.to_csv(tmp_path / "a.csv", index=False)
    task = SequenceTask(("a", "b"))
    if line is None:
        assert read_trial(tmp_path / "a.csv", task=task).warnings == ()
    else:
        refused(rf"a\.csv: column t: is {line}", read_trial, tmp_path / "a.csv", task=task)


def test_interpolation_and_labels_by_hand(tmp_path):
    ticks = np.array([0, 5, 10, 15, 20, 100, 110])
    values, marked = interpolated(ticks, np.array([0, 10, 20, 110]), np.array([0.0, 1.0, 4.0, 5.0]))
    np.testing.assert_allclose(values, [0.0, 0.5, 1.0, 2.5, 4.0, np.nan, 5.0])
    assert marked.tolist() == [False, True, False, True, False, False, False]
    t = np.array([-0.1, 0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.5, 0.6, 0.7])
    index, sd = label(t, SPANS)
    assert index.tolist() == [-1, 0, 0, 0, 1, 1, 1, 2, 2, -1]
    np.testing.assert_allclose(sd, [np.nan, 0, 0, 0.01, 0.01, 0.01, 0.03, 0.0, 0.0, np.nan])
    pd.DataFrame({"t": t}).to_csv(tmp_path / "a.csv", index=False)
    write_table(tmp_path / "b.csv", tmp_path / "a.csv", Trial("a.csv", t, {}), SPANS)
    names = pd.read_csv(tmp_path / "b.csv", keep_default_na=False)["subtask"].tolist()
    assert names == ["", *["reach"] * 3, *["push"] * 3, *["leave"] * 2, ""]
    assert label(t, ())[0].tolist() == [-1] * 10


def test_robomimic_demonstrations(tmp_path):
    path = write_robomimic(tmp_path / "demos.hdf5")
    assert parts_of(path) == ["demo_0", "demo_1"]
    rig = parse_rig({"columns": {"z": "obs/robot0_eef_pos[2]", "x": "obs/robot0_eef_pos[0]"}})
    trial = read_trial(f"{path}#demo_1", rig, SequenceTask(("a",), channels=("x", "z")))
    assert (trial.rate, trial.stem) == (pytest.approx(20.0), "demos_demo_1")
    np.testing.assert_allclose(trial.channels["x"], np.arange(50) * 0.01)
    np.testing.assert_array_equal(trial.channels["z"], 1.0)
    assert not any("image" in name for name in read_table(f"{path}#demo_0").names)
    refused(r"demos\.hdf5: holds 2 recordings; expected demos.hdf5#demo_0 for one", read_table, path)
    line = r"demos\.hdf5#demo_7: no such recording; expected demo_0, demo_1"
    refused(line, read_table, f"{path}#demo_7")


@pytest.mark.parametrize("version", [2, 3])
def test_lerobot_episodes_are_read_and_written_back_with_subtasks(tmp_path, version):
    folder = write_lerobot(tmp_path / "set", version)
    assert parts_of(folder) == ["0", "1", "2"]
    rig = parse_rig({"columns": {"t": "timestamp", "x": "observation.state.right_x"}})
    trial = read_trial(f"{folder}#2", rig, SequenceTask(("a",), channels=("x", "action.b")))
    np.testing.assert_allclose(trial.t, np.arange(60) / 50, atol=1e-6)
    np.testing.assert_array_equal(trial.channels["x"], np.arange(60) * 2 + 3)
    np.testing.assert_array_equal(trial.channels["action.b"], 1.0)
    rig = parse_rig({"columns": {"t": "timestamp"}})
    trial = read_trial(f"{folder}#1", rig, SequenceTask(("a",), channels=("action.b",)))
    for place, write in lerobot_files(folder, {1: (trial, SPANS)}).items():
        (tmp_path / "new" / place).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / "new" / place)
    info = json.loads((tmp_path / "new/meta/info.json").read_text())
    language = {"dtype": "language", "shape": [1], "names": None}
    assert [info["features"][name] for name in ("language_persistent", "language_events")] == [language] * 2
    files = sorted((tmp_path / "new/data").rglob("*.parquet"))
    rows = [row for file in files for row in pq.read_table(file).to_pylist()]
    assert not any(row["language_persistent"] for row in rows if row["episode_index"] != 1)
    one = [row for row in rows if row["episode_index"] == 1]
    said = {"role": "assistant", "style": "subtask", "camera": None, "tool_calls": None}
    assert all(row["language_events"] == [] for row in rows)
    for row in one:  # every sample repeats what is said of its episode
        assert row["language_persistent"] == [
            said | {"content": s.subtask, "timestamp": pytest.approx(s.start)} for s in SPANS
        ]
    held = read_table(f"{tmp_path}/new#1").columns["language.subtask"].tolist()
    expected = ["reach" if t < 0.25 else "push" if t < 0.4 else "leave"
                for t in [row["timestamp"] for row in one]]  # fmt: skip
    assert held == expected
    again = read_trial(f"{tmp_path}/new#1", rig, SequenceTask(("a",), channels=("action.b",)))
    np.testing.assert_array_equal(again.channels["action.b"], 1.0)
    refused("has subtasks already; expected no labels yet", lerobot_files, tmp_path / "new", {})


def test_wide_columns_and_parts_are_told_by_their_names(tmp_path):
    wide = np.arange(30.0).reshape(10, 3)
    np.savez(tmp_path / "a.npz", t=np.arange(10) * 0.1, pose=wide)
    column = pa.FixedSizeListArray.from_arrays(pa.array(wide.ravel()), 3)
    pq.write_table(pa.table({"t": np.arange(10) * 0.1, "pose": column}), tmp_path / "a.parquet")
    for name in ("a.npz", "a.parquet"):
        table = read_table(tmp_path / name, ["t", "pose[2]"])
        assert list(table.columns) == ["t", "pose[2]"]
        np.testing.assert_array_equal(table.columns["pose[2]"], wide[:, 2])
    (tmp_path / "a#b.csv").write_text("t\n")
    assert split_part(tmp_path / "a#b.csv") == (tmp_path / "a#b.csv", None)
    assert split_part(tmp_path / "c.hdf5#demo_1") == (tmp_path / "c.hdf5", "demo_1")
    assert kind_of(tmp_path / "a#b.csv") == "delimited"


@pytest.mark.parametrize(("kind", "library", "extra"), [
    ("a.mcap", "mcap", "mcap"), ("a.bag", "rosbags", "bag"), ("a.h5", "h5py", "hdf5"),
    ("a.parquet", "pyarrow", "parquet")])  # fmt: skip
def test_a_missing_extra_says_what_to_install(tmp_path, monkeypatch, kind, library, extra):
    (tmp_path / kind).write_bytes(b"x")
    monkeypatch.setitem(sys.modules, library, None)
    line = rf"needs {library}, which is not installed; expected pip install 'hmmseg\[{extra}\]'"
    refused(line, read_table, tmp_path / kind)


@pytest.mark.parametrize("kind", ["mcap", "ROS 1 bag"])
def test_a_log_cut_off_is_read_as_far_as_it_goes_or_is_one_line(tmp_path, kind):
    path = LOGS[kind](tmp_path)
    whole, sizes = path.read_bytes(), []
    for share in (0.0, 0.0005, 0.3, 0.7, 0.9999):
        path.write_bytes(whole[: int(share * len(whole))])
        try:
            trial = read_trial(path, TOPICS, LOGGED)
        except InputError as error:
            assert "\n" not in str(error)
            sizes.append(0)
            continue
        assert any("broken off" in each or "breaks off" in each for each in trial.warnings)
        np.testing.assert_allclose(trial.channels["push"], -force(FAST[: trial.t.size]), rtol=1e-12)
        sizes.append(trial.t.size)
    assert sizes == sorted(sizes) and sizes[1] == 0 and sizes[-1] == FAST.size


def span(name, start, end, start_sd=0.0, end_sd=0.0, obj=None):
    return Span(name, obj, name, start, end, start_sd, end_sd, (start, start), (end, end))


SPANS = span("reach", 0.0, 0.25, 0.0, 0.01), span("push", 0.25, 0.4, 0.01,
                                                  0.03), span("leave", 0.4, 0.6, 0.03)  # fmt: skip


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_segment_writes_columns(tmp_path, kind):
    source = tmp_path / f"trial.{kind}"
    frame = pd.read_csv(NONE / "trial_01.csv").assign(note="kept")
    frame.to_csv(source, index=False) if kind == "csv" else frame.to_parquet(source)
    args = ["segment", str(source), *HAND, "--quiet", "--json", str(tmp_path / "a.json")]
    assert main([*args, "--write", str(tmp_path / f"out.{kind}")]) == 0
    back = pd.read_csv(tmp_path / "out.csv") if kind == "csv" else pd.read_parquet(tmp_path / "out.parquet")
    assert list(back.columns) == [*frame.columns, *ADDED]
    pd.testing.assert_frame_equal(back[frame.columns], frame, check_dtype=False)
    (trial,) = json.loads((tmp_path / "a.json").read_text())["trials"]
    for number, each in enumerate(trial["segments"]):
        inside = (back["t"] >= each["start"]) & (back["t"] < each["end"])
        assert (back["subtask_index"][inside] == number).all()
        assert (back["state"][inside] == each["state"]).all()
    assert main([*args, "--write", str(tmp_path / "folder")]) == 0
    assert os.listdir(tmp_path / "folder") == [f"trial.{kind}"]


def test_a_topic_of_a_new_mcap(tmp_path):
    source = mcap_of(tmp_path / "a.mcap", planted())
    rig = parse_rig({"topics": {"f": "/wrench.wrench.force.x"}})
    trial = read_trial(source, rig, SequenceTask(("a",), channels=("f",)))
    write_topic(tmp_path / "b.mcap", source, trial, SPANS)
    with (tmp_path / "b.mcap").open("rb") as new, source.open("rb") as old:
        messages = list(make_reader(new).iter_messages())
        kept = [(c.topic, m.log_time, m.data) for _, c, m in messages if c.topic != "/hmmseg/subtask"]
        assert kept == [(c.topic, m.log_time, m.data) for _, c, m in make_reader(old).iter_messages()]
    added = [(m.log_time, json.loads(m.data)) for _, c, m in messages if c.topic == "/hmmseg/subtask"]
    assert [when for when, _ in added] == [START + round(s.start * 1e9) for s in SPANS]
    assert [body["subtask"] for _, body in added] == ["reach", "push", "leave"]
    assert added[1][1]["end_sd"] == 0.03
    again = read_trial(tmp_path / "b.mcap", rig, SequenceTask(("a",), channels=("f",)))
    np.testing.assert_array_equal(again.channels["f"], trial.channels["f"])


@pytest.mark.parametrize(("write", "trials", "line"), [
    ("trial_01.csv", 1, "--write .*: would write over its own recording; expected another place"),
    ("out.csv", 2, "--write out.csv: is one file for 2 recordings; expected a folder"),
    (".", 1, "--write .: would write over its own recording"),
    ("file/out.csv", 1, "--write file: .*file is not a folder"),
    ("file", 1, "--write file: .*file is not a folder; expected a folder")])  # fmt: skip
def test_destinations_refused_before_the_work(tmp_path, monkeypatch, capsys, write, trials, line):
    monkeypatch.chdir(tmp_path)
    for k in range(1, trials + 1):
        Path(f"trial_{k:02d}.csv").write_bytes((NONE / f"trial_{k:02d}.csv").read_bytes())
    Path("file").write_text("")
    before = sorted(os.listdir())
    names = [f"trial_{k:02d}.csv" for k in range(1, trials + 1)]
    assert main(["segment", *names, *HAND, "--write", write]) == 2
    assert re.search(line, capsys.readouterr().err) and sorted(os.listdir()) == before


def test_labels_are_not_written_twice(tmp_path, capsys):
    frame = pd.read_csv(NONE / "trial_01.csv").assign(subtask=1)
    frame.to_csv(tmp_path / "a.csv", index=False)
    args = ["segment", str(tmp_path / "a.csv"), *HAND, "--quiet"]
    assert main([*args, "--write", str(tmp_path / "b.csv")]) == 2
    assert "column subtask: is there already; expected a recording without labels" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["a.csv"]
