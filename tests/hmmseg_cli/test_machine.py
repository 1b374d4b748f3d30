"""Whatever a machine or its user does to a command: one line and exit 2 or 130, or the whole result."""

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
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hmmseg.example import example_folder
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
COSTLY = {"watch": 30, "diagnose": 5}  # how many calls of each kind are refused at most
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

    def __init__(self, real, error, at=-1, counted=lambda *_: True):
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
         "rename": (os, "replace", FULL, lambda *_: True),
         "copy": (shutil, "copyfile", FULL, lambda *_: True), "folder": (os, "mkdir", FULL, lambda *_: True),
         "write": (os, "fdopen", FULL, lambda *_: True), "sync": (os, "fsync", FULL, lambda *_: True),
         "memory": (json, "dumps", MemoryError(), lambda *_: True),
         "Ctrl-C in a copy": (shutil, "copyfile", KeyboardInterrupt(), lambda *_: True),
         "Ctrl-C in a rename": (os, "replace", KeyboardInterrupt(), lambda *_: True)}  # fmt: skip


def tortured(lab, name, kind, monkeypatch, capsys, most):
    """Refuse each call of a kind in turn; the number of calls that a command makes."""
    module, attribute, error, counted = CALLS[kind]
    real, before = getattr(module, attribute), files(lab)
    assert run(name, monkeypatch) == 0  # everything is imported, and kept that is kept
    whole, count = files(lab), Refusing(real, error, counted=counted)
    with monkeypatch.context() as patched:
        patched.setattr(module, attribute, count)
        restore(lab, before)
        assert run(name, patched) == 0
    for at in range(0, count.calls, max(1, count.calls // most)):
        restore(lab, before)
        capsys.readouterr()
        with monkeypatch.context() as patched:
            patched.setattr(module, attribute, Refusing(real, error, at, counted))
            code = run(name, patched)
        err, found = capsys.readouterr().err, files(lab)
        assert code in ((130,) if isinstance(error, KeyboardInterrupt) else (0, 2)), (at, err)
        assert found.keys() in (before.keys(), whole.keys()), (at, found.keys() ^ before.keys())
        assert code != 130 or found == {name: whole[name] for name in found}, at
        assert code != 2 or (found == before and err.count("\n") >= 1), (at, err)
        assert "Traceback" not in err and not [n for n in found if ".hmmseg" in n]
    return count.calls


@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize("name", QUICK)
def test_whatever_call_is_refused(name, kind, lab, monkeypatch, capsys):
    tortured(lab, name, kind, monkeypatch, capsys, 6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", CALLS)
@pytest.mark.parametrize("name", COMMANDS)
def test_whichever_call_is_refused(name, kind, lab, monkeypatch, capsys):
    tortured(lab, name, kind, monkeypatch, capsys, COSTLY.get(name, 10_000))


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
@pytest.mark.parametrize("name", INTERRUPTED)
def test_ctrl_c_at_any_moment(name, lab, capsys):
    """In process, everything loaded: an alarm interrupts at moments drawn from a run's length."""
    before = files(lab)
    main(COMMANDS[name])
    restore(lab, before)
    began = time.perf_counter()
    main(COMMANDS[name])
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
                    code = main(COMMANDS[name])
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


def sent(command, moment, stdin=None):
    """Standard output and error of a process that gets Ctrl-C after so many seconds, and its exit code."""
    process = subprocess.Popen([*PROCESS, *command], stdin=stdin or subprocess.DEVNULL,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               start_new_session=True)  # fmt: skip
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    return out.decode(), err.decode(), process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("moment", [4.0, 9.0, 14.0, 21.0, 30.0, 45.0])
def test_ctrl_c_while_diagnosing(moment, lab):
    before = files(lab)
    trials = ["trial.csv", "trial_2.csv", "trial_3.csv"]
    _, err, code = sent(["diagnose", *trials, *HAND, "--json", "out.json", "--report", "gap.html"], moment)
    assert "Traceback" not in err
    new = files(lab).keys() - before.keys()
    assert (code, new) in ((0, {"out.json", "gap.html"}), (130, set()))


@pytest.mark.slow
@pytest.mark.parametrize("moment", [3.0, 5.0, 8.0, 12.0])
def test_ctrl_c_while_watching(moment, lab):
    before = files(lab)
    rows = (lab / "trial.csv").read_text().splitlines(keepends=True)
    read, write = os.pipe()
    feeder = threading.Thread(target=_feed, args=(write, rows))
    feeder.start()
    out, err, code = sent(["watch", *HAND, "--json", "out.json"], moment, stdin=read)
    os.close(read)
    feeder.join()
    assert "Traceback" not in err
    lines = [json.loads(line) for line in out.splitlines()]
    new = files(lab).keys() - before.keys()
    assert (code, new) in ((0, {"out.json"}), (130, set()))
    assert code == 130 or lines[-1]["final"]


def _feed(write, rows):
    with contextlib.suppress(BrokenPipeError), os.fdopen(write, "w") as pipe:
        for row in rows:
            pipe.write(row)
            pipe.flush()
            time.sleep(0.02)


@pytest.mark.parametrize("name", [name for name in INTERRUPTED if name != "new"])
def test_the_same_seed_gives_the_same_digits(name, lab):
    before = files(lab)
    main([*COMMANDS[name], "--seed", "5"])
    first = files(lab)
    restore(lab, before)
    main([*COMMANDS[name], "--seed", "5"])
    assert files(lab) == first
