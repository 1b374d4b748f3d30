"""Long recordings stay on disk and are segmented as in one piece."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hmmseg import example_folder
from hmmseg.errors import InputError
from hmmseg.hand import read as long
from hmmseg.hand.read import LongRecording
from hmmseg.io.rig import Rig
from hmmseg.io.task import Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import segment, segment_long
from hmmseg_cli.main import app

ROUNDS = 3


@pytest.fixture(scope="module")
def repeated():
    """A recording of the example, performed again and again, and its description."""
    import dataclasses

    folder = example_folder()
    rig, task = Rig.read(folder / "rig.toml"), Task.read(folder / "task.toml")
    trial = Trial.read(folder / "trial_01.csv", rig)
    length = trial.t[-1] - trial.t[0] + np.median(np.diff(trial.t))
    t = np.concatenate([trial.t + k * length for k in range(ROUNDS)])
    columns = {"t": t} | {name: np.tile(values, ROUNDS) for name, values in trial.channels.items()}
    return columns, dataclasses.replace(task, repeat="unknown"), rig


def write(columns, path):
    if path.suffix == ".npz":
        (np.savez_compressed if "packed" in path.name else np.savez)(path, **columns)
    else:
        pytest.importorskip("pandas").DataFrame(columns).to_parquet(path, row_group_size=200)
    return path


@pytest.mark.parametrize("name", ["long.npz", "packed.npz", "long.parquet"])
@pytest.mark.parametrize("piece", [53, 10_000])
def test_the_same_answer_from_disk_as_from_memory(repeated, tmp_path, name, piece):
    columns, task, rig = repeated
    path = write(columns, tmp_path / name)
    whole = segment([Trial.read(path, rig)], task, rig)[0]
    assert whole.repetitions == ROUNDS
    found = segment_long(LongRecording(path, rig, piece), task, rig)
    assert found.spans == whole.spans
    assert (found.repetitions, found.failures, found.log_evidence, found.rate) == (
        whole.repetitions, whole.failures, whole.log_evidence, whole.rate
    )  # fmt: skip


def test_rows_are_those_of_the_file_in_any_order(repeated, tmp_path):
    columns, _, rig = repeated
    recording = LongRecording(write(columns, tmp_path / "long.npz"), rig, piece=40)
    np.testing.assert_array_equal(recording.t, columns["t"])
    for start, stop in ((0, 10), (35, 130), (120, 121), (30, 50), (len(recording.t) - 5, len(recording.t))):
        trial = recording.rows(start, stop)
        np.testing.assert_array_equal(trial.t, columns["t"][start:stop])
        for channel, values in trial.channels.items():
            np.testing.assert_array_equal(values, columns[channel][start:stop])


def test_a_fault_far_into_a_long_recording_is_named_with_its_row(repeated, tmp_path):
    columns, _, rig = repeated
    back = columns | {"t": columns["t"].copy()}
    back["t"][300] = back["t"][299]
    with pytest.raises(InputError, match="row 301, column t"):
        LongRecording(write(back, tmp_path / "back.npz"), rig, piece=300)
    odd = columns | {"fx1": columns["fx1"].copy()}
    odd["fx1"][310] = np.inf
    with pytest.raises(InputError, match="row 311, column fx1"):
        LongRecording(write(odd, tmp_path / "odd.npz"), rig, piece=100)


def test_the_command_keeps_long_recordings_on_disk(repeated, tmp_path, monkeypatch):
    columns, task, _ = repeated
    path = write(columns, tmp_path / "long.npz")
    monkeypatch.setattr("hmmseg_cli.segment.read_task", lambda _: task)
    folder = example_folder()
    command = ["segment", str(path), "--task", str(folder / "task.toml"), "--rig", str(folder / "rig.toml")]
    documents = []
    for rows in (10**9, 100):
        monkeypatch.setattr(long, "LONG", rows)
        out = tmp_path / f"{rows}.json"
        result = CliRunner().invoke(app, [*command, "--json", str(out)])
        assert result.exit_code == 0, result.output
        documents.append(json.loads(out.read_text()))
    assert documents[0]["trials"] == documents[1]["trials"]
    assert documents[0]["trials"][0]["repetitions"] == ROUNDS
