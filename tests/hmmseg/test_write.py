"""Labelled copies: every sample's subtask by hand, read back with the field's own libraries."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from file_writers import START, write_lerobot, write_mcap
from mcap.reader import make_reader

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import read_table
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask
from hmmseg.segmentation.spans import Span
from hmmseg_cli.labels import ADDED, label, lerobot_files
from hmmseg_cli.labels import write_mcap as write_topic
from hmmseg_cli.main import main

NONE = Path(__file__).resolve().parents[2] / "recordings/none_1"


def span(name, start, end, start_sd=0.0, end_sd=0.0, obj=None):
    return Span(name, obj, name, start, end, start_sd, end_sd, (start, start), (end, end))


SPANS = (
    span("reach", 0.0, 0.25, 0.0, 0.01),
    span("push", 0.25, 0.4, 0.01, 0.03),
    span("leave", 0.4, 0.6, 0.03),
)


def test_labels_by_hand():
    t = np.array([-0.1, 0.0, 0.1, 0.2, 0.25, 0.3, 0.35, 0.5, 0.6, 0.7])
    found = label(t, SPANS)
    assert found.index.tolist() == [-1, 0, 0, 0, 1, 1, 1, 2, 2, -1]
    np.testing.assert_allclose(found.boundary_sd, [np.nan, 0, 0, 0.01, 0.01, 0.01, 0.03, 0.0, 0.0, np.nan])
    assert found.names("subtask").tolist() == ["", *["reach"] * 3, *["push"] * 3, *["leave"] * 2, ""]
    assert label(t, ()).index.tolist() == [-1] * 10


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_segment_writes_columns(tmp_path, kind):
    source = tmp_path / f"trial.{kind}"
    frame = pd.read_csv(NONE / "trial_01.csv").assign(note="kept")
    frame.to_csv(source, index=False) if kind == "csv" else frame.to_parquet(source)
    args = ["segment", str(source), "--task", str(NONE / "task.toml"), "--rig", str(NONE / "rig.toml"),
            "--method", "qualitative", "--quiet", "--json", str(tmp_path / "a.json")]  # fmt: skip
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
    source = write_mcap(tmp_path / "a.mcap")
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


@pytest.mark.parametrize("version", [2, 3])
def test_a_lerobot_data_set_with_subtasks(tmp_path, version):
    folder = write_lerobot(tmp_path / "set", version)
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
    expected = [
        "reach" if t < 0.25 else "push" if t < 0.4 else "leave" for t in [row["timestamp"] for row in one]
    ]
    assert held == expected
    again = read_trial(f"{tmp_path}/new#1", rig, SequenceTask(("a",), channels=("action.b",)))
    np.testing.assert_array_equal(again.channels["action.b"], 1.0)
    with pytest.raises(InputError, match="has subtasks already; expected no labels yet"):
        lerobot_files(tmp_path / "new", {})


@pytest.mark.parametrize(
    ("write", "trials", "line"),
    [
        ("trial_01.csv", 1, "--write .*: would write over its own recording; expected another place"),
        ("out.csv", 2, "--write out.csv: is one file for 2 recordings; expected a folder"),
        (".", 1, "--write .: would write over its own recording"),
        ("file/out.csv", 1, "--write file: .*file is not a folder"),
        ("file", 1, "--write file: .*file is not a folder; expected a folder"),
    ],
)
def test_destinations_refused_before_the_work(tmp_path, monkeypatch, capsys, write, trials, line):
    monkeypatch.chdir(tmp_path)
    for k in range(1, trials + 1):
        Path(f"trial_{k:02d}.csv").write_bytes((NONE / f"trial_{k:02d}.csv").read_bytes())
    Path("file").write_text("")
    before = sorted(os.listdir())
    names = [f"trial_{k:02d}.csv" for k in range(1, trials + 1)]
    assert main(["segment", *names, "--task", str(NONE / "task.toml"), "--rig", str(NONE / "rig.toml"),
                 "--method", "qualitative", "--write", write]) == 2  # fmt: skip
    assert re.search(line, capsys.readouterr().err)
    assert sorted(os.listdir()) == before


def test_labels_are_not_written_twice(tmp_path, capsys):
    frame = pd.read_csv(NONE / "trial_01.csv").assign(subtask=1)
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert main(["segment", str(tmp_path / "a.csv"), "--task", str(NONE / "task.toml"), "--rig",
                 str(NONE / "rig.toml"), "--method", "qualitative", "--quiet", "--write",
                 str(tmp_path / "b.csv")]) == 2  # fmt: skip
    assert "column subtask: is there already; expected a recording without labels" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["a.csv"]
