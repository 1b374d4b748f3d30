"""The frame of the commands: exit codes, one line of error, strict JSON, all files or none."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import hmmseg
from hmmseg.errors import InputError
from hmmseg_cli import main as frame
from hmmseg_cli.console import Output, distinct_trials, find_inputs, require_rig, strict_json

HMMSEG = Path(sys.executable).with_name("hmmseg")
TASK = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'


def run(*args: str, **more) -> subprocess.CompletedProcess:
    return subprocess.run([HMMSEG, *args], capture_output=True, text=True, check=False, **more)


@pytest.fixture
def task(tmp_path) -> Path:
    path = tmp_path / "task.toml"
    path.write_text(TASK)
    return path


def test_processes_say_one_line_of_bad_input_and_show_the_traceback_of_a_bug(tmp_path):
    (tmp_path / "bad.toml").write_text(TASK.replace('to = "ground"', 'to = "table"'))
    done = run("decompose", "bad.toml", "--json", "out.json", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("bad.toml: move 1: unknown destination 'table'; expected one of block1, ")
    assert done.stderr.count("\n") == 1 and os.listdir(tmp_path) == ["bad.toml"]
    code = """if True:
        import sys
        from hmmseg_cli import describe, main
        describe.decompose_task = lambda task: 1 / 0
        sys.exit(main.main(["decompose", sys.argv[1]]))
    """
    (tmp_path / "good.toml").write_text(TASK)
    command = [sys.executable, "-c", code, tmp_path / "good.toml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr.startswith("Traceback")
    assert done.stderr.endswith("ZeroDivisionError: division by zero\n")


def test_light_commands_do_not_import_heavy_modules():
    heavy = ("jax", "numpy", "numba", "pandas", "matplotlib", "scipy", "arviz", "jinja2")
    code = f"import sys, hmmseg_cli.main; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_version_and_help_with_groups_and_examples(capsys):
    assert frame.main(["--version"]) == 0 and capsys.readouterr().out == f"{hmmseg.__version__}\n"
    for args in ([], ["--help"], ["-h"]):
        assert frame.main(args) == 0 and "decompose" in capsys.readouterr().out
    assert frame.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"{group}:" in out for group in frame.COMMANDS) and "Commands:" not in out
    for group in frame.COMMANDS.values():
        for command, example in group.items():
            assert frame.main([command.__name__, "--help"]) == 0
            shown = capsys.readouterr().out
            assert example.splitlines()[-1] in shown
            random = command.__name__ in ("identify", "simulate", "diagnose", "play", "demo")
            assert ("--seed" in shown) == random


@pytest.mark.parametrize(("args", "line"), [
    (["decompse"], "hmmseg: No such command 'decompse'"),
    (["decompose"], "hmmseg decompose: Missing argument 'TASK'"),
    (["decompose", "a", "--jsn", "b"], "hmmseg decompose: No such option: --jsn"),
    (["decompose", "a", "b"], "hmmseg decompose: Got unexpected extra argument"),
    (["decompose", "a", "--seed", "x"], "hmmseg decompose: Invalid value for '--seed'"),
    (["decompose", "a", "--seed", "-1"], "hmmseg decompose: Invalid value for '--seed'"),
    (["decompose", "a", "--json"], "hmmseg: Option '--json' requires an argument"),
    (["--nonsense"], "hmmseg: No such option: --nonsense"),
    (["decompose", "absent.toml"], "absent.toml: no such file; expected a TOML file")])  # fmt: skip
def test_usage_at_fault(capsys, args, line):
    assert frame.main(args) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1) and err.startswith(line)


def test_task_and_rig_are_found_beside_the_trials(tmp_path, task):
    trial, rig = tmp_path / "trial.csv", tmp_path / "rig.toml"
    trial.write_text("t\n")
    assert find_inputs([trial], None, None) == (task, None)
    rig.write_text("rate = 50.0\n")
    assert find_inputs([trial], None, None) == (task, rig)
    other = tmp_path / "other.toml"
    other.write_text('sequence = ["approach", "press"]\n')
    assert find_inputs([trial], other, None) == (other, None)  # a plain task needs no hand
    hand = rig.read_text()
    rig.write_text('[columns]\nt = {from = "time"}\n')  # but how its files are read, as inspect writes it
    assert find_inputs([trial], other, None) == (other, rig)
    rig.write_text(hand)
    refused(r"--task .*rig.toml: describes no task; .*swapped\?", find_inputs, [trial], rig, task)
    refused(r"--rig .*other.toml: describes a task", find_inputs, [trial], task, other)
    task.unlink()
    refused(r"--task: missing; expected .*or a task.toml in", find_inputs, [trial], None, None)
    refused("--rig: missing", require_rig, None, [trial])


@pytest.mark.parametrize(("arguments", "message"), [
    ({"json": "{}/trial.csv"}, "--json .*trial.csv: would be written over, .*; expected a .json file"),
    ({"json": "{}"}, "--json .*: is a folder; expected a file"),
    ({"json": "{}/file/a.json"}, "--json .*file is not a folder; expected a folder"),
    ({"report": "{}/a.json"}, "--report .*a.json: unknown kind of file; expected .html or .htm"),
    ({"figures": "{}/file"}, "--figures .*file is not a folder; expected a folder"),
    ({"figures": "{}/file/below"}, "--figures .*file is not a folder")])  # fmt: skip
def test_destinations_are_checked_beforehand(tmp_path, arguments, message):
    (tmp_path / "file").write_text("")
    given = {name: value.format(tmp_path) for name, value in arguments.items()}
    refused(f"^{message}", Output, "test", json=given.get("json"), figures=Path(given["figures"])
            if "figures" in given else None, report=Path(given["report"]) if "report" in given
            else None)  # fmt: skip


def test_destinations_are_links_and_devices_but_none_without_permission(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text("old")
    with monkeypatch.context() as patched:
        patched.setattr("hmmseg_cli.console.os.access", lambda path, mode: False)  # root may write anywhere
        for arguments in ({"json": str(tmp_path / "a.json")}, {"json": str(tmp_path / "b.json")},
                          {"report": tmp_path / "c.html"}, {"figures": tmp_path / "d"}):  # fmt: skip
            refused("cannot be written", Output, "test", **arguments)
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("real.json")
    for name in (str(tmp_path / "link.json"), os.devnull):
        with Output("test", json=name, quiet=True) as out:
            out.finish({})
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "real.json").read_text())["format"] == "hmmseg.test/1"
    assert Path(os.devnull).is_char_device()


def test_files_appear_together_at_the_end_or_not_at_all(tmp_path):
    with Output("test", json=str(tmp_path / "a.json"), figures=tmp_path / "new/figures",
                report=tmp_path / "r.html", quiet=True) as out:  # fmt: skip
        out.warn("beware")
        out.figure("one.png").write_bytes(b"1")
        out.figure("one.png").write_bytes(b"2")
        out.stage(tmp_path / "r.html").write_text("<p>")
        assert os.listdir(tmp_path) == []
        out.finish({"value": 1})
    figure = tmp_path / "new/figures/one.png"
    assert figure.read_bytes() == b"2" and (tmp_path / "r.html").read_text() == "<p>"
    document = json.loads((tmp_path / "a.json").read_text())
    assert document == {"format": "hmmseg.test/1", "version": hmmseg.__version__, "seed": 0,
                        "warnings": ["beware"], "figures": [str(figure)], "value": 1}  # fmt: skip
    assert sorted(os.listdir(tmp_path)) == ["a.json", "new", "r.html"]


def test_a_failure_leaves_everything_as_it_was(tmp_path):
    (tmp_path / "a.json").write_text("old")
    with (pytest.raises(InputError),
          Output("test", json=str(tmp_path / "a.json"), figures=tmp_path / "figures") as out):  # fmt: skip
        out.figure("one.png").write_bytes(b"1")
        raise InputError("here", "wrong")
    assert (tmp_path / "a.json").read_text() == "old" and os.listdir(tmp_path) == ["a.json"]


def test_standard_output_is_kept_clean_and_quiet(capsys):
    with Output("test", json="-") as out:
        out.print("to people")
        print("a stray print")
        out.warn("beware")
        with out.progress("sampling", 3) as advance:
            advance(3)
        out.finish({"value": np.nan})
    printed = capsys.readouterr()
    assert json.loads(printed.out)["value"] is None and "to people\n" in printed.err
    assert "a stray print\n" in printed.err and "warning: beware\n" in printed.err
    with Output("test", quiet=True) as out:
        out.print("to people")
        out.warn("beware")
        out.finish({})
    assert tuple(capsys.readouterr()) == ("", "")


def test_documents_are_strict_json_and_trials_distinct(tmp_path):
    document = {"a": np.array([1.0, np.nan]), "b": (np.float32(0.5), np.int64(3), np.bool_(True)),
                "c": float("inf"), "d": [float("-inf"), None, "x"], "e": Path("p"), 3: "µ"}  # fmt: skip
    plain = {"a": [1.0, None], "b": [0.5, 3, True], "c": None, "d": [None, None, "x"], "e": "p", "3": "µ"}
    assert json.loads(strict_json(document), parse_constant=pytest.fail) == plain
    with pytest.raises(TypeError):
        strict_json({"a": object()})
    paths = [tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "copy.csv"]
    for path, text in zip(paths, "aba", strict=True):
        path.write_text(text)
    assert distinct_trials(paths[:2]) == paths[:2]
    for twice in ([paths[0], paths[0]], [paths[0], tmp_path / "." / "a.csv"], [paths[0], paths[2]]):
        refused(r"csv: the same trial as .*a\.csv; expected every trial once", distinct_trials, twice)
    refused(r"absent\.csv: no such file; expected a trial", distinct_trials, [tmp_path / "absent.csv"])
    refused("is a folder; expected a trial", distinct_trials, [tmp_path])
