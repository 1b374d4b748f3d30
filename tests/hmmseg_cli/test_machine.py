"""The frame of the commands, and whatever a machine or its user does to one."""

import builtins
import contextlib
import ctypes
import io
import json
import os
import pty
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import hmmseg
from hmmseg.example import example_folder
from hmmseg_cli import main as frame
from hmmseg_cli.console import Output, distinct_trials, find_inputs, require_rig, strict_json
from hmmseg_cli.main import main, repeat_interrupts

STACK = Path(__file__).parents[1] / "data/stack"
HAND = ["--task", "task.toml", "--rig", "rig.toml"]
COMMANDS = {"decompose": ["decompose", "task.toml", "--json", "out.json"],
            "effects": ["effects", "--json", "out.json"],
            "inspect": ["inspect", "theirs.csv", "--write", "new.toml", "--json", "out.json"],
            "new": ["new", "lab"], "segment": ["segment", "trial.csv", *HAND, "--method", "qualitative",
                                               "--json", "out.json", "--write", "labelled.csv"],
            "identify": ["identify", "trial.csv", *HAND, "--method", "paper", "--json", "out.json",
                         "--report", "page.html"],
            "fit": ["fit", "trial.csv", "--task", "order.toml", "--model", "model.npz", "--json", "out.json"],
            "simulate": ["simulate", *HAND, "--trials", "1", "--output", "made", "--json", "out.json"],
            "watch": ["watch", *HAND, "--json", "out.json"],
            "diagnose": ["diagnose", "trial.csv", "--against", "trial_2.csv", "trial_3.csv", "--task",
                         "order.toml", "--json", "out.json"]}  # fmt: skip
INTERRUPTED = ("decompose", "inspect", "new", "segment", "identify", "fit", "simulate")
QUICK = ("decompose", "new", "segment")
ROWS = b"".join((STACK / "trial_01.csv").read_bytes().splitlines(keepends=True)[:40])
FULL = OSError(28, "No space left on device")
PROCESS = [sys.executable, "-c", "from hmmseg_cli import run; run()"]  # as the installed command has it
MOVES = 'objects = {a = {on = "ground"}}\nmoves = [' + '{object = "a", to = "ground"},' * 20_000 + "]"
STATES = "sequence = [" + ", ".join(f'"s{i}"' for i in range(9000)) + "]"
COLUMNS = "t" + "".join(f",c{i}" for i in range(300_000)) + "\n0\n"


@pytest.fixture
def lab(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "order.toml").write_text('sequence = ["reach", "grip", "leave"]\nchannels = ["fx1", "fy1"]\n')
    shutil.copyfile(example_folder() / "task.toml", tmp_path / "task.toml")
    shutil.copyfile(STACK / "rig.toml", tmp_path / "rig.toml")
    shutil.copyfile(STACK / "trial_01.csv", tmp_path / "trial.csv")
    rows = (tmp_path / "trial.csv").read_text().splitlines(keepends=True)
    theirs = ["stamp", *(f"joint_{name}" for name in rows[0].split(",")[1:])]
    (tmp_path / "theirs.csv").write_text("".join([",".join(theirs), *rows[1:]]))
    for number in (2, 3):
        (tmp_path / f"trial_{number}.csv").write_text("".join(rows[: -2 * number]))
    return tmp_path


def run(name, monkeypatch):
    """A command, which reads a recording on standard input where it reads any."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(ROWS)))
    return main(COMMANDS[name])


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def restore(folder, before):
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and str(path.relative_to(folder)) not in before:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()
    for name, content in before.items():
        if (folder / name).read_bytes() != content:
            (folder / name).write_bytes(content)


class Refusing:
    """Counts calls of a function of the system, and refuses the one of this number."""

    def __init__(self, real, error, at, counted=lambda *_: True):
        self.real, self.error, self.at, self.counted, self.calls = real, error, at, counted, 0

    def __call__(self, *arguments, **more):
        if self.counted(*arguments):
            self.calls += 1
            if self.calls - 1 == self.at:
                raise self.error
        return self.real(*arguments, **more)


def own(path, *_):
    """Whether a path is data, and no code of a package that is still being imported."""
    name = os.fspath(path) if isinstance(path, str | os.PathLike) else ""
    return (not str(name).endswith((".py", ".pyc", ".so", ".afm", ".ttf", ".mplstyle"))
            and "site-packages" not in name)  # fmt: skip


CALLS = {"open": (builtins, "open", PermissionError(13, "Permission denied"), own),
         "io.open": (io, "open", OSError(24, "Too many open files"), own),
         "rename": (os, "replace", FULL), "copy": (shutil, "copyfile", FULL), "folder": (os, "mkdir", FULL),
         "write": (os, "fdopen", FULL), "sync": (os, "fsync", FULL), "memory": (json, "dumps", MemoryError()),
         "Ctrl-C in a copy": (shutil, "copyfile", KeyboardInterrupt()),
         "Ctrl-C in a rename": (os, "replace", KeyboardInterrupt())}  # fmt: skip


def tortured(lab, name, kind, monkeypatch, capsys, most):
    """Refuse each call of a kind in turn; the number of calls that a command makes."""
    module, attribute, error, *counted = CALLS[kind]
    real, before = getattr(module, attribute), files(lab)
    assert run(name, monkeypatch) == 0  # everything is imported, and kept that is kept
    whole, count = files(lab), Refusing(real, error, -1, *counted)
    with monkeypatch.context() as patched:
        patched.setattr(module, attribute, count)
        restore(lab, before)
        assert run(name, patched) == 0
    for at in range(0, count.calls, max(1, count.calls // most)):
        restore(lab, before)
        capsys.readouterr()
        with monkeypatch.context() as patched:
            patched.setattr(module, attribute, Refusing(real, error, at, *counted))
            code = run(name, patched)
        err, found = capsys.readouterr().err, files(lab)
        assert code in ((130,) if isinstance(error, KeyboardInterrupt) else (0, 2)), (at, err)
        assert found.keys() in (before.keys(), whole.keys()), (at, found.keys() ^ before.keys())
        assert code != 130 or found == {name: whole[name] for name in found}, at
        assert code != 2 or (found == before and err.count("\n") >= 1), (at, err)
        assert "Traceback" not in err and not [n for n in found if ".hmmseg" in n]
    return count.calls


EVERY = {name: 10_000 for name in COMMANDS} | {"watch": 30, "diagnose": 5}  # calls that are refused at most


@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize(("name", "most"), [*((name, 6) for name in QUICK), *(
    pytest.param(*each, marks=pytest.mark.slow) for each in EVERY.items())])  # fmt: skip
def test_whatever_call_is_refused(name, most, kind, lab, monkeypatch, capsys):
    tortured(lab, name, kind, monkeypatch, capsys, most)


def test_whatever_the_machine_refuses_results_of_before_stay_and_folders_are_named(lab, monkeypatch, capsys):
    assert main(COMMANDS["fit"]) == 0
    before, real = files(lab), os.replace
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", Refusing(real, FULL, 1, lambda new, to: ".old" not in str(new)))
        assert main([*COMMANDS["fit"], "--seed", "3"]) == 2
    assert files(lab) == before and "cannot be written (No space left on device)" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        patched.setattr(os, "access", lambda _, mode: not mode & os.W_OK)
        for command, where in ((["decompose", "task.toml", "--json", "new.json"], "--json new.json"),
                               (["demo"], "--report demo/report.html")):  # fmt: skip
            assert main(command) == 2
            assert capsys.readouterr().err.startswith(f"{where}: {lab} cannot be written")
    monkeypatch.setattr(tempfile, "tempdir", str(lab / "nowhere"))
    assert main(COMMANDS["decompose"]) == 2 and "temporary files: cannot be used" in capsys.readouterr().err


@pytest.mark.parametrize("stdout", ["closed", "full", "gone"])
def test_without_a_reader_the_work_is_kept_and_said(stdout, lab):
    command = shlex.join([*PROCESS, *COMMANDS["decompose"]])
    end = {"closed": ">&-", "full": "> /dev/full", "gone": "| true"}[stdout]
    run = subprocess.run(["bash", "-c", f"set -o pipefail; {{ sleep 0; {command}; }} {end}"],
                         capture_output=True, text=True)  # fmt: skip
    assert (lab / "out.json").exists()
    assert "Traceback" not in run.stderr and "Exception ignored" not in run.stderr
    if stdout != "gone" or run.stderr:  # `true` may have read nothing yet when all was written
        assert run.returncode == 2 and run.stderr.count("\n") == 1
        assert run.stderr.startswith("standard output: cannot be written to") and "out.json" in run.stderr


def test_without_a_reader_of_json_a_line_says_so(lab):
    command = shlex.join([*PROCESS, "decompose", "task.toml", "--json", "-", "--quiet"])
    run = subprocess.run(["bash", "-c", f"{command} > /dev/full"], capture_output=True, text=True)
    assert run.returncode == 2 and run.stderr.startswith("standard output: cannot be written to (No space")


def test_odd_names_and_no_home_do_no_harm(lab, capsys, monkeypatch):
    odd = os.fsdecode(b"caf\xe9\x1b[31m.csv")
    shutil.copyfile("trial.csv", odd)
    assert main(["segment", odd, *HAND, "--method", "qualitative", "--json", "out.json"]) == 0
    assert os.fsencode(json.loads(Path("out.json").read_text())["trials"][0]["file"]) == os.fsencode(odd)
    assert "\x1b" not in capsys.readouterr().out and main(["segment", odd.replace("31", "32"), *HAND]) == 2
    assert "\x1b" not in capsys.readouterr().err
    longest = "a" * 250 + ".json"
    assert main(["decompose", "task.toml", "--json", longest]) == 0 and Path(longest).exists()
    for name in ("a" * 251 + ".json", "\0.json"):
        assert main(["decompose", "task.toml", "--json", name]) == 2
    assert main(["segment", "b" * 252 + ".csv", *HAND]) == 2
    packages = [Path(sys.modules[n].__file__).parent for n in ("hmmseg", "hmmseg_cli")]

    def content():
        return {p: p.stat().st_mtime_ns for f in packages for p in f.rglob("*")
                if "__pycache__" not in str(p)}  # fmt: skip

    before = content()
    monkeypatch.setenv("HOME", "/proc/nowhere")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    for name in ("segment", "new"):
        assert main(COMMANDS[name]) == 0
    assert content() == before


def test_a_page_watched_in_the_terminal_leaves_standard_output_alone(lab):
    rows = Path("trial.csv").read_bytes().splitlines(keepends=True)[:40]
    script = f"exec {shlex.join(PROCESS)} watch --plot {' '.join(HAND)} > answers.jsonl"
    main_end, terminal = pty.openpty()  # standard error is a terminal, as a user has it
    run = subprocess.Popen(["bash", "-c", script], stdin=subprocess.PIPE, stderr=terminal)
    os.close(terminal)
    run.stdin.write(b"".join(rows))
    run.stdin.close()
    with contextlib.suppress(OSError):
        while os.read(main_end, 65536):
            pass
    os.close(main_end)
    assert run.wait(120) == 0
    lines = [json.loads(line) for line in Path("answers.jsonl").read_text().splitlines()]
    assert len(lines) == len(rows) and lines[-1]["final"]


@pytest.mark.parametrize(("name", "text", "line"), [
    ("task.toml", MOVES, "moves: 20000 moves, repeat 1; expected 2000 moves in all at most"),
    ("task.toml", STATES, "sequence: 9000 states; expected 2000 at most"),
    ("trial.csv", COLUMNS, "has 300001 columns; expected 20000"),
    ("trial.csv", "t," + "x" * 10_000_000, "row 1: is longer than 10000000 bytes")])  # fmt: skip
def test_what_nobody_means_is_refused_before_anything_is_made_of_it(name, text, line, lab, capsys):
    (lab / name).write_text(text)
    began = time.process_time()
    assert main(["segment", "trial.csv", *HAND]) == 2
    assert line in capsys.readouterr().err and time.process_time() - began < 5


@pytest.mark.parametrize("value", ["1e-300", "1e9", "1" + "0" * 400, "inf", "nan", "-1", "true"])
@pytest.mark.parametrize("key", ["weight", "width"])
def test_properties_that_nothing_has_are_refused(value, key, lab, capsys):
    values = {"weight": "0.4", "width": "0.02", "height": "0.02"} | {key: value}
    units = {"weight": "N", "width": "m", "height": "m"}
    text = "".join(
        f"[{b}]\n" + "".join(f'{k} = {{unit = "{units[k]}", value = {v}}}\n' for k, v in values.items())
        for b in ("block1", "block2")
    )
    (lab / "actual.toml").write_text(text)
    assert main(["simulate", *HAND, "--properties", "actual.toml", "--output", "made"]) == 2
    err = capsys.readouterr().err
    assert f"block1.{key}" in err and "a number > 0" in err and len(err) < 300
    table = {b: {k: json.loads(v.replace("inf", "Infinity").replace("nan", "NaN")) for k, v in values.items()}
             for b in ("block1", "block2")}  # fmt: skip
    (lab / "found.json").write_text(json.dumps({"properties": table}))
    assert main(["simulate", *HAND, "--properties", "found.json", "--output", "made"]) == 2
    assert f"block1.{key}" in capsys.readouterr().err


# Slow, as an alarm that goes off in the wrong place ends the whole test run.
# A reader interrupted between opening a file and holding on to it leaves its closing to Python.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
@pytest.mark.parametrize("name", [*INTERRUPTED, "watch", "diagnose"])
def test_ctrl_c_at_any_moment(name, lab, monkeypatch, capsys):
    """In process, everything loaded: an alarm interrupts at moments drawn from a run's length."""
    before = files(lab)
    run(name, monkeypatch)
    restore(lab, before)
    began = time.perf_counter()
    run(name, monkeypatch)
    length, whole = time.perf_counter() - began, files(lab)

    def interrupt(*_):
        raise KeyboardInterrupt

    usual, rng = signal.signal(signal.SIGALRM, interrupt), np.random.default_rng(7)
    try:
        for moment in rng.uniform(0.02, 1.0, 4) * length:
            restore(lab, before)
            try:
                try:
                    signal.setitimer(signal.ITIMER_REAL, moment)
                    code = run(name, monkeypatch)
                finally:  # where the alarm may still go off
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:  # before or after the command itself
                code = 130
            assert code in (0, 130) and files(lab).keys() in (before.keys(), whole.keys())
    finally:
        signal.signal(signal.SIGALRM, usual)
    assert "Traceback" not in capsys.readouterr().err


def test_ctrl_c_in_a_callback_is_heard(capsys):
    """What C calls can raise nothing; the interrupt comes when it has returned."""

    @ctypes.CFUNCTYPE(None)
    def called():
        raise KeyboardInterrupt

    # As a command has it, whatever ran before.
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), repeat_interrupts():
            called()
            for _ in range(100):
                time.sleep(0.05)
    finally:
        signal.signal(signal.SIGINT, usual)
    assert capsys.readouterr().err == ""


def test_ctrl_c_while_the_command_is_imported(lab):
    """As on a machine so busy that imports take seconds."""
    stop = """
import sys
class Interrupted:
    def find_spec(name, *_):
        if name == "typer":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted)
"""
    command = [sys.executable, "-c", stop + PROCESS[-1], "decompose", "task.toml"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("name", [name for name in INTERRUPTED if name != "new"])
def test_the_same_seed_gives_the_same_digits(name, lab):
    before = files(lab)
    main([*COMMANDS[name], "--seed", "5"])
    first = files(lab)
    restore(lab, before)
    main([*COMMANDS[name], "--seed", "5"])
    assert files(lab) == first


TASK = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'


def test_processes_say_one_line_of_bad_input_and_show_the_traceback_of_a_bug(tmp_path):
    (tmp_path / "bad.toml").write_text(TASK.replace('to = "ground"', 'to = "table"'))
    command = [Path(sys.executable).with_name("hmmseg"), "decompose", "bad.toml", "--json", "out.json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
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


def test_packages_and_light_commands_import_no_heavy_modules_and_leave_jax_alone():
    heavy = ("jax", "numpy", "numba", "pandas", "matplotlib", "scipy", "arviz", "jinja2")
    code = f"""import sys, hmmseg, estimation, simgap, hmmseg_cli.main
print([name for name in {heavy} if name in sys.modules])
import jax
before = dict(jax.config.values)
from hmmseg import align
from estimation import identify
from simgap import diagnose
print(before == jax.config.values)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\nTrue\n"


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


def test_task_and_rig_are_found_beside_the_trials(tmp_path):
    task, trial, rig = tmp_path / "task.toml", tmp_path / "trial.csv", tmp_path / "rig.toml"
    task.write_text(TASK)
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


def test_a_report_of_a_fault_names_what_is_installed(capsys):
    assert main(["doctor", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["format"] == "hmmseg.doctor/1" and found["packages"]["numpy"] == np.__version__
    assert found["packages"].keys() >= {"mujoco", "h5py"} and "hmmseg" not in found["packages"]
    assert sys.executable in found["python"] and found["hmmseg"].startswith(hmmseg.__version__)
