"""Whatever a reader or a cache is given: a result or one line, nothing half-written."""

import io
import json
import math
import os
import pickle
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused

from experiments.fuzz import run
from hmmseg import cache
from hmmseg.cache import CacheWarning, cache_folder, keep, kept
from hmmseg.errors import InputError
from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import npz
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.task import parse_task, read_task
from hmmseg.io.trial import Trial
from hmmseg.online.watcher import Watcher
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.model import load_model, save_model
from hmmseg_cli.main import main
from hmmseg_cli.rows import Rows
from simgap.world.operator import OperatorSettings, read_operator
from simgap.world.properties import read_properties

TASK = parse_task({"objects": {"a": {"on": "ground"}}, "moves": [{"object": "a", "to": "ground"}]})
READERS = {"trial": lambda path: read_trial(path, parse_rig({})),
           "model": lambda path: load_model(path, parse_task({"sequence": ["a", "b"]})), "rig": read_rig,
           "task": read_task, "operator": read_operator,
           "properties": lambda path: read_properties(path, TASK)}  # fmt: skip
STACK = Path(__file__).parents[1] / "data/stack"
MOVES = (example_folder() / "task.toml").read_text(encoding="utf-8")
SOME = settings(max_examples=int(os.environ.get("HMMSEG_EXAMPLES", "60")), deadline=None,
                suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
CARTESIAN = ("x1", "y1", "fx1", "fy1", "x2", "y2", "fx2", "fy2")
CELLS = st.one_of(st.floats().map(repr), st.integers().map(str),
                  st.sampled_from(["", " ", "nan", "-inf", "1,5", "0x1", "1e400", '"', "\x00", "٣",
                                   "9" * 400]), st.text(max_size=6))  # fmt: skip
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12)  # fmt: skip
KEYS = ("rate", "gravity", "fingertip", "noise", "systematic", "tolerance", "columns", "topics", "gripper",
        "fingers", "effects", "objects", "moves", "repeat", "sequence", "channels", "optional")  # fmt: skip
DOCUMENTS = st.one_of(
    VALUES,
    st.dictionaries(st.sampled_from(sorted(OperatorSettings.model_fields)), VALUES, max_size=3),
    st.fixed_dictionaries({"properties": st.fixed_dictionaries({"a": VALUES})}),
)
LAB = example_folder()
STREAM = (LAB / "trial_01.csv").read_bytes().splitlines()
LINES = st.lists(st.one_of(st.integers(1, 60).map(lambda k: STREAM[k]), st.binary(max_size=40),
                           st.tuples(st.integers(1, 60), st.integers(0, 12), CELLS)),
                 max_size=25)  # fmt: skip
ARRAYS = st.one_of(st.floats(), st.integers(-5, 5), st.text(max_size=4),
                   st.lists(st.floats(), max_size=3), st.just(np.zeros((2, 0))))  # fmt: skip
EDITS = st.lists(st.tuples(st.integers(0, 40), st.one_of(st.none(), ARRAYS)), min_size=1, max_size=3)
HOSTILE = {"pickled": lambda path: np.savez(path, t=np.arange(9.0), x1=np.array([Exploding()], dtype=object)),
           "bare pickle": lambda path: path.write_bytes(pickle.dumps(Exploding())),
           "zip bomb": lambda path: claiming(path, 2_000_000_000, 50_000_000, zipfile.ZIP_DEFLATED),
           "huge claim": lambda path: claiming(path, 10**15, 80, zipfile.ZIP_STORED),
           "climbing": lambda path: zipped(path, "../../escaped.npy"),
           "unheard of": lambda path: zipped(path, "format.npy", 203)}  # fmt: skip


class Exploding:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def claiming(path, size, held, how):
    """An archive of an array that claims so many numbers, of which the file holds so many bytes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (size,)})
    with zipfile.ZipFile(path, "w", how) as file:
        file.writestr("t.npy", header.getvalue() + bytes(held))


def zipped(path, name, version=0):
    """An archive of one file; `version`: ten times that of the format which it says it needs."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(name, b"x")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 6] = version or data[data.index(b"PK\x01\x02") + 6]
    path.write_bytes(data)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".hdf5", ".mcap", ".bag", ".toml"])
def test_a_folder_a_loop_and_nothing_are_no_file(suffix, tmp_path):
    folder, loop, absent = (tmp_path / f"{name}{suffix}" for name in ("folder", "loop", "absent"))
    folder.mkdir()
    loop.symlink_to(loop)
    for path in (folder, loop, absent):
        reader = read_rig if suffix == ".toml" else READERS["trial"]
        assert str(path) in refused("", reader, path)


def test_damaged_tables_without_header_and_archives_too_large_give_a_result_or_a_line(tmp_path, monkeypatch):
    found = run(cases=600, seed=int.from_bytes(b"ci", "big"))  # a subset of `make fuzz`
    assert not found["failures"], found["failures"][0]["trace"]
    assert found["outcomes"]["refused"] > 50
    text, line = "1.0,2.0\n1.1,2.1\n", "but the first row holds numbers"
    (tmp_path / "trial.csv").write_text(text)
    assert line in refused("", READERS["trial"], tmp_path / "trial.csv")
    assert line in refused("", Rows, io.BytesIO(text.encode()), Watcher(TASK, parse_rig({})))
    monkeypatch.setattr(npz, "BOMB", 10**6)
    np.savez_compressed(tmp_path / "t.npz", t=np.zeros(10**7))
    for read in ("trial", "model"):
        assert "unpacks from" in refused("", READERS[read], tmp_path / "t.npz")


@pytest.mark.parametrize("read", ["rig", "task"])
@pytest.mark.parametrize("content", ["a = " + "[" * 100_000, "a" + ".a" * 100_000 + " = 1",
                                     "x = 1\n" * 400_000, "a = " + "9" * 100_000])  # fmt: skip
def test_toml_bombs(content, read, tmp_path):
    path = tmp_path / "bomb.toml"
    path.write_text(content)
    refused("", READERS[read], path)


def test_what_is_refused_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("task.toml").write_text(MOVES)
    Path("bad.csv").write_text("t,x1\n0,zero\n")
    rows = (STACK / "trial_01.csv").read_text().splitlines()
    Path("half.csv").write_text("\n".join(rows[: len(rows) // 3]) + "\n")
    before = sorted(tmp_path.rglob("*"))
    hand = ["--task", "task.toml", "--rig", str(STACK / "rig.toml")]
    for command in (["simulate", *hand, "--replay", "half.csv", "--output", "made"],
                    ["segment", "bad.csv", *hand, "--json", "a.json", "--figures", "f", "--write", "w"],
                    ["identify", "bad.csv", *hand, "--json", "a.json", "--figures", "f", "--report",
                     "r.html"], ["inspect", "bad.csv", "--write", "bad.toml", "--json", "a.json"],
                    ["simulate", *hand, "--properties", "bad.csv", "--output", "s"]):  # fmt: skip
        assert main(command) == 2
        half, lines = "half.csv" in command, capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 + half and ("not show the whole task" in lines[-1]) == half, lines
        assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("read", "content"), [
    *(("operator", text) for text in ("[1]", "3", "[" * 100_000, '{"pace": []}', '{"pace": {"a": 1}}')),
    *(("properties", text) for text in ("[1]", "{}", '{"properties": 3}', "[" * 100_000)),
    ("properties", '{"properties": {"a": []}}'),
], ids=lambda value: value[:20])  # fmt: skip
def test_documents_that_are_none(read, content, tmp_path):
    path = tmp_path / "made.json"
    path.write_text(content)
    assert str(path) in refused("", READERS[read], path)


@pytest.mark.parametrize("read", ["trial", "model"])
@pytest.mark.parametrize("how", HOSTILE)
def test_a_hostile_archive_is_refused_and_runs_nothing(read, how, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "t.npz"
    HOSTILE[how](path)
    refused("", READERS[read], path)
    assert [each.name for each in tmp_path.iterdir()] == ["t.npz"]


def one_line(call, *arguments):
    try:
        return call(*arguments)
    except InputError as error:
        line = str(error)
        assert line and "\n" not in line and len(line) < 20_000
        return None


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("hostile")


@st.composite
def tables(draw):
    """A CSV of a Cartesian hand, a few of its cells, columns and separators anything."""
    names = list(draw(st.permutations(("t", *CARTESIAN))))
    rows = [[str(0.02 * k), *["0.1"] * len(CARTESIAN)] for k in range(draw(st.integers(0, 14)))]
    for _ in range(draw(st.integers(0, 5))):
        if rows:
            row = draw(st.sampled_from(rows))
            row[draw(st.integers(0, len(row) - 1))] = draw(CELLS)
    if draw(st.booleans()):
        names[draw(st.integers(0, len(names) - 1))] = draw(CELLS)
    separator = draw(st.sampled_from([",", ";", "\t", ", "]))
    return "\n".join(separator.join(row) for row in [names, *rows])


@SOME
@given(text=tables())
def test_tables(folder, text):
    path = folder / "made.csv"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    trial = one_line(read_trial, path, parse_rig({}))
    if trial is not None:
        assert isinstance(trial, Trial) and (np.diff(trial.t) > 0).all()
        assert all(c.shape == trial.t.shape and not np.isinf(c).any() for c in trial.channels.values())


@SOME
@given(table=st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=5))
def test_descriptions(table):
    for parse in (parse_rig, parse_task):
        one_line(parse, table)


@SOME
@given(document=DOCUMENTS)
def test_documents(folder, document):
    path = folder / "made.json"
    path.write_text(json.dumps(document))
    blocks = one_line(read_properties, path, parse_task({"objects": {"a": {"on": "ground"}}, "moves": [
        {"object": "a", "to": "ground"}]}))  # fmt: skip
    if blocks is not None:
        assert all(math.isfinite(v) and v > 0 for v in (blocks["a"].weight, blocks["a"].width))
    one_line(read_operator, path)


@settings(SOME, max_examples=25)
@given(lines=LINES)
def test_streams(lines):
    text = [STREAM[0]]
    for line in lines:
        if isinstance(line, tuple):
            cells = STREAM[line[0]].split(b",")
            cells[line[1]] = line[2].encode("utf-8", "surrogatepass")
            line = b",".join(cells)
        text.append(line)
    watcher = Watcher(read_task(LAB / "task.toml"), read_rig(LAB / "rig.toml"), 0.1)
    rows = Rows(io.BytesIO(b"\n".join(text)), watcher)
    for _ in range(len(text) + 50):  # bytes may hold line ends
        row = one_line(rows.next)
        if row is not None:
            json.loads(watcher.update(*row).line(), parse_constant=pytest.fail)
    final = one_line(watcher.finish)
    assert (final is None) == (not watcher.counts["rows"])
    if final is not None:
        json.loads(final.line(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def model(folder):
    task = parse_task({"sequence": ["a", "b"], "channels": ["x"]})
    t = np.arange(60) / 20
    trial = read_trial({"t": t, "x": np.where(t < 1.5, 0.0, 1.0) + 0.01 * np.sin(9 * t)}, None, task)
    path = folder / "model.npz"
    save_model(fit_sequence([trial], task), path)
    with np.load(path) as file:
        return task, dict(file)


def check_model(folder, model, edits):
    task, table = model
    table = dict(table)
    names = sorted(table)
    for k, value in edits:
        name = names[k % len(names)]
        if value is None:
            table.pop(name, None)
        else:
            table[name] = np.asarray(value)
    path = folder / "edited.npz"
    np.savez(path, **table)
    one_line(load_model, path, task)


@SOME
@given(edits=EDITS)
def test_models(folder, model, edits):
    check_model(folder, model, edits)


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e300])
def test_a_model_with_any_one_number_impossible(folder, model, value):
    for k in range(len(model[1])):
        check_model(folder, model, [(k, value)])


PROGRAM = """
import sys
from hmmseg.jaxconfig import configure, double_precision
configure()
import jax, jax.numpy as jnp
jax.monitoring.register_event_listener(lambda event, **_: print(event) if "cache_" in event else None)
print(double_precision(lambda: jax.jit(lambda x: (x * x).sum())(jnp.arange(5.0)))())
"""
FUNCTION = """
from hmmseg.online.compiled import compiled
@compiled
def double(x):
    return 2 * x
print(double(1.5), sum(double.stats.cache_hits.values()))
"""


@pytest.fixture(autouse=True)
def unsaid(monkeypatch):
    monkeypatch.setattr(cache, "_said", set())


@pytest.mark.parametrize("damage", ["empty", "cut", "garbled", "foreign", "pickle", "folder", "swapped"])
def test_a_damaged_file_is_said_once_and_made_anew(damage, tmp_path):
    path, other = tmp_path / "new/one.json", tmp_path / "new/other.json"
    for each in (path, other):
        keep(each, b"\x00[1, 2]\xff")
        assert kept(each) == b"\x00[1, 2]\xff"
        content = bytearray(each.read_bytes())
        middle = len(content) // 2
        content[middle] ^= 0x10
        each.unlink()
        if damage == "folder":
            each.mkdir()
            continue
        each.write_bytes({
            "empty": b"", "cut": bytes(content[:middle]), "garbled": bytes(content), "foreign": b"\xff" * 99,
            "pickle": pickle.dumps([1, 2]), "swapped": cache.MAGIC + bytes(32),
        }[damage])  # fmt: skip
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert kept(path) is kept(other) is None
    assert [w.category for w in said] == ([] if damage == "folder" else [CacheWarning])
    keep(path, b"3")
    assert kept(path) == (None if damage == "folder" else b"3")
    assert {"one.json"} <= {*os.listdir(tmp_path / "new")} <= {"one.json", "other.json"}


@pytest.mark.parametrize("where", ["/proc/nowhere", "a file", "relative", ""])
def test_without_a_home_nothing_is_kept_and_nothing_fails(where, tmp_path, monkeypatch):
    (tmp_path / "a file").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / where) if where == "a file" else where)
    monkeypatch.setenv("HOME", "/proc/nowhere")
    folder = cache_folder()
    keep(folder / "one.json", b"1")
    assert kept(folder / "one.json") is None and os.listdir(tmp_path) == ["a file"]


def test_compiled_programs_are_kept_and_compiled_anew_where_they_are_damaged(tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": ""}

    def run():
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True,
                              text=True)  # fmt: skip
        assert done.stdout.endswith("30.0\n")
        return "cache_hits" in done.stdout, done.stderr

    (tmp_path / "hmmseg").write_text("")
    assert run() == (False, "")  # there is nowhere to keep them
    (tmp_path / "hmmseg").unlink()
    assert run() == (False, "")
    programs = list((tmp_path / "hmmseg/programs").iterdir())
    for program in programs:
        content = bytearray(program.read_bytes())
        content[len(content) // 2] ^= 0xFF
        program.write_bytes(content)
    hit, said = run()
    assert programs and not hit and said.count("not as it was written") == 1 and run() == (True, "")


def test_functions_are_kept_and_compiled_anew_where_they_are_damaged(tmp_path):
    program, environment = tmp_path / "program.py", {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    program.write_text(FUNCTION)
    environment.pop("NUMBA_CACHE_DIR", None)

    def run():
        done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True)
        return done.stdout.strip(), "not as it was written" in done.stderr

    assert run() == ("3.0 0", False) and run() == ("3.0 1", False)
    for kind in "nbi", "nbc":
        (file,) = (tmp_path / "hmmseg/numba").rglob(f"*.{kind}")
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 0xFF
        file.write_bytes(content)
        assert run() == ("3.0 0", True) and run() == ("3.0 1", False)
    program.write_text("import numba\nnumba.__version__ = 'another'\n" + FUNCTION)
    assert run() == ("3.0 0", False) and len([*(tmp_path / "hmmseg/numba").iterdir()]) == 2
