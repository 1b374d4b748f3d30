"""A cache is a convenience: what is damaged, foreign or nowhere to be written counts as nothing."""

import os
import pickle
import subprocess
import sys
import warnings

import pytest

from hmmseg import cache
from hmmseg.cache import CacheWarning, cache_folder, keep, kept

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


def test_bytes_come_back_as_they_were(tmp_path):
    keep(tmp_path / "new/one.json", b"\x00\xff")
    assert kept(tmp_path / "new/one.json") == b"\x00\xff"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["one.json"]


@pytest.mark.parametrize("damage", ["empty", "cut", "garbled", "foreign", "pickle", "folder", "swapped"])
def test_a_damaged_file_is_said_once_and_made_anew(damage, tmp_path):
    path, other = tmp_path / "one.json", tmp_path / "other.json"
    for each in (path, other):
        keep(each, b"[1, 2]")
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
