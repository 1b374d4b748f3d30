"""Repeated tasks: every round aligned, one that fails leaves the others; long recordings stay on disk."""

import json
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from misfit_edits import RIG, TRIALS, TRUTH, join, let_go
from refusals import refused
from typer.testing import CliRunner

from hmmseg import example_folder
from hmmseg.contact.decompose import subtasks
from hmmseg.hand import read as long
from hmmseg.hand.read import LongRecording
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Move, Task
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align, segment, segment_long
from hmmseg.segmentation.rounds import round_tasks
from hmmseg_cli.main import app

PICK = BlockTask({"block1": "ground"}, (Move("block1", "ground"),), repeat="unknown")
BACK = BlockTask({"a": "ground", "b": "ground"}, (Move("a", "ground"), Move("b", "ground")), repeat="unknown")
BEFORE, AFTER = 0.6, 0.5  # s of free motion kept about a move
ROUNDS = 3


def pieces(moves: tuple[int, ...], number: int, dropped: int | None = None):
    """A session of rounds of these moves and its boundaries [s]; in round `dropped` a block falls."""
    parts, truth, clock = [], [], 0.0
    for r in range(number):
        for m in moves:
            trial, b = TRIALS[r % 3], TRUTH[r % 3]
            part = join(trial, (b[4 * m] - BEFORE, b[4 * m + 3] + AFTER))
            at = np.array(b[4 * m : 4 * m + 4]) - trial.t[trial.t >= b[4 * m] - BEFORE][0]
            if r == dropped and m == moves[-1]:
                quiet = Trial(part.file, part.t, part.channels)
                part, at = let_go(quiet, at, (at[1] + at[2]) / 2, np.inf), at[:2]
            parts.append(part)
            truth.append(clock + at)
            clock += part.t.size * 0.05
    channels = {k: np.concatenate([p.channels[k] for p in parts]) for k in parts[0].channels}
    t = 0.05 * np.arange(len(next(iter(channels.values()))))
    return Trial("session.csv", t, channels), truth


@cache
def aligned_session(moves: tuple[int, ...], number: int, repeat, dropped: int | None = None):
    session, truth = pieces(moves, number, dropped)
    task = replace(PICK if len(moves) == 1 else BACK, repeat=repeat)
    aligned = align([session], task, RIG)
    return aligned, truth


@pytest.mark.parametrize("repeat", ["unknown", 6])
@pytest.mark.parametrize("moves", [(0,), (0, 1)])
def test_every_round_is_aligned(moves, repeat):
    aligned, truth = aligned_session(moves, 6, repeat)
    found = aligned.trials[0].segmentation
    assert found.complete and found.repetitions == 6 and aligned.task.repeat == 6
    assert len(found.spans) == len(aligned.subtasks) == 1 + 4 * len(moves) * 6
    assert [(s.subtask, s.object) for s in found.spans] == [(s.name, s.object) for s in aligned.subtasks]
    starts = np.array([s.start for s in found.spans[1:]])
    assert np.abs(starts - np.concatenate(truth)).max() < 0.05
    assert len(aligned.trials[0].boundaries) == starts.size and aligned.trials[0].present.all()


@pytest.mark.parametrize(("repeat", "number", "at"),
                         [("unknown", 10, 6), (10, 10, 6), ("unknown", 100, 56), (100, 100, 56)])  # fmt: skip
def test_a_drop_in_one_round_leaves_the_others(repeat, number, at):
    aligned, truth = aligned_session((0,), number, repeat, dropped=at)
    trial, steps = aligned.trials[0], aligned.subtasks
    found = trial.segmentation
    assert found.repetitions == number
    (failure,) = found.failures
    assert found.failed == failure and failure.repetition == at + 1
    assert failure.index == 4 * at + 3 and "let go in mid-air" in failure.reason
    assert str(failure).startswith(f"does not fit its task at place block1: repetition {at + 1}: ")
    assert np.flatnonzero(~trial.present).tolist() == [4 * at + 3]
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert document["failed"]["repetition"] == at + 1 and len(document["failures"]) == 1
    starts = np.array([b.quantile(0.5) for b in trial.boundaries])
    others = [k for k in range(len(steps) - 1) if k // 4 != at]
    known = np.concatenate([t for r, t in enumerate(truth) if r != at])
    assert np.abs(starts[others] - known).max() < 0.05


def test_a_block_gripped_again_makes_no_further_round():
    aligned, _ = aligned_session((0,), 11, 10, dropped=6)
    found = aligned.trials[0].segmentation
    assert [f.repetition for f in found.failures] == [7]
    assert "let go in mid-air" in found.failures[0].reason and "gripped again" in found.failures[0].reason


@pytest.mark.parametrize(("shown", "asked"), [(5, 6), (6, 5)])
def test_too_few_or_too_many_rounds(shown, asked):
    aligned, _ = aligned_session((0,), shown, asked)
    found = aligned.trials[0].segmentation
    assert found.repetitions == shown and found.failed is not None and found.failed.repetition == 6
    words = "ends before it" if shown < asked else "goes on after the task's end with another grip at "
    assert words in found.failed.reason


def test_recordings_differ_in_rounds_which_start_where_the_last_left_the_blocks():
    sessions = [pieces((0,), n)[0] for n in (3, 5)]
    aligned = align(sessions, PICK, RIG)
    assert aligned.task.repeat == 5 and len(aligned.subtasks) == 21
    assert [t.segmentation.repetitions for t in aligned.trials] == [3, 5]
    assert [t.segmentation.complete for t in aligned.trials] == [True, True]
    assert [int(t.present.sum()) for t in aligned.trials] == [13, 21]
    assert [len(t.boundaries) for t in aligned.trials] == [20, 20]
    task = BlockTask({"a": "b", "b": "ground"}, (Move("a", "ground"),), repeat=3)
    tasks = round_tasks(task, 3)
    assert [t.initial["a"] for t in tasks] == ["b", "ground", "ground"]
    assert [s.state for s in subtasks(tasks[1])] == [s.state for s in subtasks(tasks[0])]


@pytest.mark.slow
def test_hundreds_of_rounds_cost_no_more_each():
    seconds = {}
    for number in (40, 40, 320):  # the first compiles
        session, _ = pieces((0,), number)
        began, aligned = time.process_time(), align([session], PICK, RIG)
        seconds[number] = (time.process_time() - began) / number
        assert aligned.trials[0].segmentation.repetitions == number
        assert aligned.trials[0].segmentation.complete
    assert seconds[320] < 1.6 * seconds[40]


@pytest.fixture(scope="module")
def repeated():
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
        whole.repetitions, whole.failures, whole.log_evidence, whole.rate)  # fmt: skip


def test_rows_are_those_of_the_file_and_a_fault_is_named_with_its_row(repeated, tmp_path):
    columns, _, rig = repeated
    recording = LongRecording(write(columns, tmp_path / "long.npz"), rig, piece=40)
    np.testing.assert_array_equal(recording.t, columns["t"])
    for start, stop in ((0, 10), (35, 130), (120, 121), (30, 50), (len(recording.t) - 5, len(recording.t))):
        trial = recording.rows(start, stop)
        np.testing.assert_array_equal(trial.t, columns["t"][start:stop])
        for channel, values in trial.channels.items():
            np.testing.assert_array_equal(values, columns[channel][start:stop])
    back = columns | {"t": columns["t"].copy()}
    back["t"][300] = back["t"][299]
    refused("row 301, column t", LongRecording, write(back, tmp_path / "back.npz"), rig, piece=300)
    odd = columns | {"fx1": columns["fx1"].copy()}
    odd["fx1"][310] = np.inf
    refused("row 311, column fx1", LongRecording, write(odd, tmp_path / "odd.npz"), rig, piece=100)


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
