"""Bad input: each gives its one line, and nothing is half-written."""

import io
import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from experiments.fuzz import run
from hmmseg.errors import InputError
from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.task import parse_task, read_task
from hmmseg.sequence.model import load_model
from hmmseg_cli.main import main
from simgap.world.operator import read_operator
from simgap.world.properties import read_properties

TASK = parse_task({"objects": {"a": {"on": "ground"}}, "moves": [{"object": "a", "to": "ground"}]})
READERS = {
    "trial": lambda path: read_trial(path, parse_rig({})),
    "model": lambda path: load_model(path, parse_task({"sequence": ["a", "b"]})),
    "rig": read_rig,
    "task": read_task,
    "operator": read_operator,
    "properties": lambda path: read_properties(path, TASK),
}
STACK = Path(__file__).parents[1] / "data/stack"
MOVES = (example_folder() / "task.toml").read_text(encoding="utf-8")


def told(call, *arguments):
    """The line that a call gives."""
    with pytest.raises(InputError) as error:
        call(*arguments)
    line = str(error.value)
    assert "\n" not in line
    assert len(line) < 2000
    return line


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


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".hdf5", ".mcap", ".bag", ".toml"])
def test_a_folder_a_loop_and_nothing_are_no_file(suffix, tmp_path):
    folder, loop, absent = (tmp_path / f"{name}{suffix}" for name in ("folder", "loop", "absent"))
    folder.mkdir()
    loop.symlink_to(loop)
    for path in (folder, loop, absent):
        reader = read_rig if suffix == ".toml" else READERS["trial"]
        assert str(path) in told(reader, path)


@pytest.mark.parametrize("read", ["rig", "task"])
@pytest.mark.parametrize(
    "content",
    ["a = " + "[" * 100_000, "a" + ".a" * 100_000 + " = 1", "x = 1\n" * 400_000, "a = " + "9" * 100_000],
)
def test_toml_bombs(content, read, tmp_path):
    path = tmp_path / "bomb.toml"
    path.write_text(content)
    told(READERS[read], path)


def test_damaged_files_give_a_result_or_a_line():
    """A subset of `make fuzz`."""
    found = run(cases=600, seed=int.from_bytes(b"ci", "big"))
    assert not found["failures"], found["failures"][0]["trace"]
    assert found["outcomes"]["refused"] > 50


def test_what_is_refused_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("task.toml").write_text(MOVES)
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
    (tmp_path / "task.toml").write_text(MOVES)
    rows = (STACK / "trial_01.csv").read_text().splitlines()
    (tmp_path / "half.csv").write_text("\n".join(rows[: len(rows) // 3]) + "\n")
    hand = ["--task", str(tmp_path / "task.toml"), "--rig", str(STACK / "rig.toml")]
    before = sorted(tmp_path.rglob("*"))
    replay = ["--replay", str(tmp_path / "half.csv"), "--output", str(tmp_path / "made")]
    assert main(["simulate", *hand, *replay]) == 2
    assert "does not show the whole task" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("read", "content"),
    [
        *(("operator", text) for text in ("[1]", "3", "[" * 100_000, '{"pace": []}', '{"pace": {"a": 1}}')),
        *(("properties", text) for text in ("[1]", "{}", '{"properties": 3}', "[" * 100_000)),
        ("properties", '{"properties": {"a": []}}'),
    ],
    ids=lambda value: value[:20],
)  # fmt: skip
def test_documents_that_are_none(read, content, tmp_path):
    path = tmp_path / "made.json"
    path.write_text(content)
    assert str(path) in told(READERS[read], path)


def unheard_of(path):
    """An archive that says it needs version 20.3 of the format to be unpacked."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("format.npy", b"x")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 6] = 203
    path.write_bytes(data)


HOSTILE = [pickled, bare_pickle, zip_bomb, huge_claim, climbing]


@pytest.mark.parametrize(
    ("read", "make"), [*(("trial", m) for m in HOSTILE), *(("model", m) for m in (*HOSTILE, unheard_of))]
)
def test_a_hostile_archive_is_refused_and_runs_nothing(read, make, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "t.npz"
    make(path)
    told(READERS[read], path)
    assert [each.name for each in tmp_path.iterdir()] == ["t.npz"]
