"""Bad input: each gives its one line, nothing is half-written, and an interrupted run leaves nothing."""

import io
import os
import pickle
import re
import signal
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

from estimation.report import read_actual
from experiments.fuzz import run
from hmmseg.errors import InputError
from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.task import read_task
from hmmseg_cli.main import main

CORPUS = tomllib.loads((Path(__file__).parents[1] / "data/bad/corpus.toml").read_text(encoding="utf-8"))[
    "case"
]
READERS = {
    "trial": lambda path: read_trial(path, parse_rig({})),
    "gripper": lambda path: read_trial(path, parse_rig({"gripper": {}})),
    "rig": read_rig,
    "task": read_task,
    "actual": lambda path: read_actual(path, ("a", "b")),
}
STACK = Path(__file__).parents[1] / "data/stack"
TASK = (example_folder() / "task.toml").read_text(encoding="utf-8")


def told(call, *arguments):
    """The line that a call gives."""
    with pytest.raises(InputError) as error:
        call(*arguments)
    line = str(error.value)
    assert "\n" not in line
    assert len(line) < 2000
    return line


@pytest.mark.parametrize("case", CORPUS, ids=[case["file"] for case in CORPUS])
def test_each_bad_file_gives_its_line(case, tmp_path):
    path = tmp_path / case["file"]
    path.write_text(case["content"], encoding="utf-8")
    line = told(READERS[case["as"]], path)
    assert line.startswith(str(path))
    assert re.search(case["line"], line), line


class Exploding:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("exploded",)


def pickled(path):
    np.savez(path, t=np.arange(9.0), x1=np.array([Exploding()], dtype=object))


def bare_pickle(path):
    path.write_bytes(pickle.dumps(Exploding()))


def zip_bomb(path):
    """An array that claims a thousand times what the file holds."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2_000_000_000,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("t.npy", header.getvalue() + bytes(50_000_000))


def huge_claim(path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("t.npy", header.getvalue() + bytes(80))


def climbing(path):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("../../escaped.npy", b"x")


@pytest.mark.parametrize("make", [pickled, bare_pickle, zip_bomb, huge_claim, climbing])
def test_a_hostile_npz_is_refused_and_runs_nothing(make, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "t.npz"
    make(path)
    told(read_trial, path, parse_rig({}))
    assert [each.name for each in tmp_path.iterdir()] == ["t.npz"]


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".hdf5", ".mcap", ".bag", ".toml"])
def test_a_folder_a_loop_and_nothing_are_no_file(suffix, tmp_path):
    folder, loop, absent = (tmp_path / f"{name}{suffix}" for name in ("folder", "loop", "absent"))
    folder.mkdir()
    loop.symlink_to(loop)
    for path in (folder, loop, absent):
        reader = read_rig if suffix == ".toml" else READERS["trial"]
        assert str(path) in told(reader, path)


def test_toml_bombs(tmp_path):
    for content in (
        "a = " + "[" * 100_000,
        "a" + ".a" * 100_000 + " = 1",
        "x = 1\n" * 400_000,
        "a = " + "9" * 100_000,
    ):
        path = tmp_path / "bomb.toml"
        path.write_text(content)
        told(read_rig, path)
        told(read_task, path)


def read_task_of(sequence):
    from hmmseg.io.task import parse_task

    return parse_task({"sequence": sequence})


def test_damaged_files_give_a_result_or_a_line():
    """A subset of `make fuzz`."""
    found = run(cases=600, seed=int.from_bytes(b"ci", "big"))
    assert not found["failures"], found["failures"][0]["trace"]
    assert found["outcomes"]["refused"] > 50


def test_what_is_refused_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("task.toml").write_text(TASK)
    Path("bad.csv").write_text("t,x1\n0,zero\n")
    before = sorted(tmp_path.rglob("*"))
    hand = ["--task", "task.toml", "--rig", str(STACK / "rig.toml")]
    for command in (
        ["segment", "bad.csv", *hand, "--json", "a.json", "--figures", "f", "--write", "w"],
        ["identify", "bad.csv", *hand, "--json", "a.json", "--figures", "f", "--report", "r.html"],
        ["inspect", "bad.csv", "--write", "bad.toml", "--json", "a.json"],
        ["simulate", *hand, "--properties", "bad.csv", "--output", "s"],
    ):
        assert main(command) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1, lines
        assert sorted(tmp_path.rglob("*")) == before


def test_a_recording_that_stops_halfway_is_no_replay(tmp_path, capsys):
    (tmp_path / "task.toml").write_text(TASK)
    rows = (STACK / "trial_01.csv").read_text().splitlines()
    (tmp_path / "half.csv").write_text("\n".join(rows[: len(rows) // 3]) + "\n")
    hand = ["--task", str(tmp_path / "task.toml"), "--rig", str(STACK / "rig.toml")]
    before = sorted(tmp_path.rglob("*"))
    replay = ["--replay", str(tmp_path / "half.csv"), "--output", str(tmp_path / "made")]
    assert main(["simulate", *hand, *replay]) == 2
    assert "does not show the whole task" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("content", ["[1]", "3", "[" * 100_000, '{"pace": []}', '{"pace": {"a": 1}}'])
def test_operator_settings_that_are_none(content, tmp_path):
    from simgap.world.operator import read_operator

    path = tmp_path / "operator.json"
    path.write_text(content)
    assert str(path) in told(read_operator, path)


@pytest.mark.parametrize(
    "content", ["[1]", "{}", '{"properties": 3}', "[" * 100_000, '{"properties": {"a": []}}']
)
def test_properties_that_are_none(content, tmp_path):
    from hmmseg.io.task import parse_task
    from simgap.world.properties import read_properties

    path = tmp_path / "identified.json"
    path.write_text(content)
    task = parse_task({"objects": {"a": {"on": "ground"}}, "moves": [{"object": "a", "to": "ground"}]})
    assert str(path) in told(read_properties, path, task)


def unheard_of(path):
    """An archive that says it needs version 20.3 of the format to be unpacked."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("format.npy", b"x")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 6] = 203
    path.write_bytes(data)


@pytest.mark.parametrize("make", [pickled, bare_pickle, zip_bomb, huge_claim, climbing, unheard_of])
def test_a_hostile_model_is_refused(make, tmp_path, monkeypatch):
    from hmmseg.sequence.model import load_model

    monkeypatch.chdir(tmp_path)
    path = tmp_path / "t.npz"
    make(path)
    told(load_model, path, read_task_of(["a", "b"]))
    assert [each.name for each in tmp_path.iterdir()] == ["t.npz"]


def identify_command(folder, output, seed="3"):
    trials = [str(STACK / f"trial_0{k}.csv") for k in (1, 2)]
    return [sys.executable, "-m", "hmmseg_cli.main", "identify", *trials, "--task", str(folder / "task.toml"),
            "--rig", str(STACK / "rig.toml"), "--json", str(output), "--quiet", "--seed", seed]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_at_any_moment_nothing_is_left(how, tmp_path):
    (tmp_path / "task.toml").write_text(TASK)
    rng = np.random.default_rng(int(how))
    for moment in rng.uniform(0.05, 6.0, 5):
        out = tmp_path / "out.json"
        process = subprocess.Popen(identify_command(tmp_path, out), stderr=subprocess.PIPE, text=True)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            process.send_signal(how)
        _, err = process.communicate(timeout=120)
        if out.exists():  # it was done by then: whole
            import json

            json.loads(out.read_text())
            out.unlink()
        assert "Traceback" not in err
        assert [path.name for path in tmp_path.iterdir()] == ["task.toml"]


@pytest.mark.slow
def test_two_runs_in_one_folder_and_the_same_seed(tmp_path):
    (tmp_path / "task.toml").write_text(TASK)
    names = ["a.json", "b.json"]
    both = [subprocess.Popen(identify_command(tmp_path, tmp_path / name)) for name in names]
    assert [process.wait(300) for process in both] == [0, 0]
    first, second = ((tmp_path / name).read_text() for name in names)
    assert first == second
