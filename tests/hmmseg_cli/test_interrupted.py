"""Ctrl-C while results are put in place, or anywhere: whole or not there; one seed, the same digits."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hmmseg.example import example_folder
from hmmseg_cli.main import main

STACK = Path(__file__).parents[1] / "data/stack"
TASK = (example_folder() / "task.toml").read_text(encoding="utf-8")
PROPERTIES = {
    "objects": {name: {"weight": 0.4, "width": 0.02, "height": 0.02} for name in ("block1", "block2")}
}
HAND = ["--task", "task.toml", "--rig", "rig.toml"]
COMMANDS = {
    "decompose": ["decompose", "task.toml", "--json", "out.json"],
    "inspect": ["inspect", "theirs.csv", "--write", "new.toml", "--json", "out.json"],
    "new": ["new", "lab"],
    "segment": ["segment", "trial.csv", *HAND, "--method", "qualitative", "--json", "out.json", "--write",
                "labelled.csv"],
    "identify": ["identify", "trial.csv", *HAND, "--method", "paper", "--json", "out.json"],
    "fit": ["fit", "trial.csv", "--task", "order.toml", "--model", "model.npz", "--json", "out.json"],
    "simulate": ["simulate", *HAND, "--trials", "1", "--output", "made", "--json", "out.json"],
}  # fmt: skip


@pytest.fixture
def lab(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task.toml").write_text(TASK)
    (tmp_path / "order.toml").write_text('sequence = ["reach", "grip", "leave"]\nchannels = ["fx1", "fy1"]\n')
    shutil.copyfile(STACK / "rig.toml", tmp_path / "rig.toml")
    shutil.copyfile(STACK / "trial_01.csv", tmp_path / "trial.csv")
    header, *rows = (tmp_path / "trial.csv").read_text().splitlines()
    theirs = ["stamp", *(f"joint_{name}" for name in header.split(",")[1:])]
    (tmp_path / "theirs.csv").write_text("\n".join([",".join(theirs), *rows]) + "\n")
    return tmp_path


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def remove(folder, kept):
    for path in folder.rglob("*"):
        if path.is_file() and str(path.relative_to(folder)) not in kept:
            path.unlink()


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("step", ["copyfile", "replace"])
def test_ctrl_c_while_results_are_put_in_place(name, step, lab, monkeypatch, capsys):
    before = files(lab)
    assert main(COMMANDS[name]) == 0
    whole = files(lab)
    assert whole.keys() > before.keys()
    of, real = (shutil, shutil.copyfile) if step == "copyfile" else (os, os.replace)
    for moment in range(len(whole) - len(before)):
        remove(lab, before)
        calls = iter(range(100))

        def interrupted(*arguments, calls=calls, moment=moment):
            if next(calls) == moment:
                raise KeyboardInterrupt
            return real(*arguments)

        with monkeypatch.context() as patched:
            patched.setattr(of, step, interrupted)
            assert main(COMMANDS[name]) == 130
        found = files(lab)
        assert found.keys() in (before.keys(), whole.keys())
        assert found == {name: whole[name] for name in found}
    assert "Traceback" not in capsys.readouterr().err


# Slow, as an alarm that goes off in the wrong place ends the whole test run.
# A reader interrupted between opening a file and holding on to it leaves its closing to Python.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_at_any_moment(name, lab, capsys):
    """In process, everything loaded: an alarm interrupts at moments drawn from a run's length."""
    before = files(lab)
    main(COMMANDS[name])
    remove(lab, before)
    began = time.perf_counter()
    main(COMMANDS[name])
    length, whole = time.perf_counter() - began, files(lab)

    def interrupt(*_):
        raise KeyboardInterrupt

    usual = signal.signal(signal.SIGALRM, interrupt)
    rng = np.random.default_rng(7)
    try:
        for moment in rng.uniform(0.02, 1.0, 4) * length:
            remove(lab, before)
            try:
                try:
                    signal.setitimer(signal.ITIMER_REAL, moment)
                    code = main(COMMANDS[name])
                finally:  # where the alarm may still go off
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:  # before or after the command itself
                code = 130
            assert code in (0, 130)
            assert files(lab).keys() in (before.keys(), whole.keys())
    finally:
        signal.signal(signal.SIGALRM, usual)
    assert "Traceback" not in capsys.readouterr().err


def test_ctrl_c_in_a_callback_is_heard(capsys):
    """What C calls can raise nothing; the interrupt comes when it has returned."""
    import ctypes

    from hmmseg_cli.main import heard

    @ctypes.CFUNCTYPE(None)
    def called():
        raise KeyboardInterrupt

    # As a command has it, whatever ran before.
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), heard():
            called()
            time.sleep(5)
    finally:
        signal.signal(signal.SIGINT, usual)
    assert capsys.readouterr().err == ""


def sent(command, moment, stdin=None):
    """Standard output and error of a process that gets Ctrl-C after so many seconds, and its exit code."""
    process = subprocess.Popen(
        [sys.executable, "-m", "hmmseg_cli.main", *command], stdin=stdin or subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    return out.decode(), err.decode(), process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("moment", [4.0, 9.0, 14.0, 21.0, 30.0, 45.0])
def test_ctrl_c_while_diagnosing(moment, lab):
    """Whole or not there, and no traceback, wherever in the search for causes it comes."""
    before = files(lab)
    for k in (2, 3):
        shutil.copyfile(STACK / f"trial_0{k}.csv", lab / f"trial_{k}.csv")
    before = files(lab)
    trials = ["trial.csv", "trial_2.csv", "trial_3.csv"]
    _, err, code = sent(["diagnose", *trials, *HAND, "--json", "out.json", "--report", "gap.html"], moment)
    assert "Traceback" not in err
    new = files(lab).keys() - before.keys()
    assert (code, new) in ((0, {"out.json", "gap.html"}), (130, set()))


@pytest.mark.slow
@pytest.mark.parametrize("moment", [3.0, 5.0, 8.0, 12.0])
def test_ctrl_c_while_watching(moment, lab):
    """Every line is whole, the last one says so, and the document is there or not."""
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
    """Rows into a pipe at the robot's pace, until nobody reads them."""
    with contextlib.suppress(BrokenPipeError), os.fdopen(write, "w") as pipe:
        for row in rows:
            pipe.write(row)
            pipe.flush()
            time.sleep(0.02)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "new"])
def test_the_same_seed_gives_the_same_digits(name, lab):
    before = files(lab)
    main([*COMMANDS[name], "--seed", "5"])
    first = files(lab)
    remove(lab, before)
    main([*COMMANDS[name], "--seed", "5"])
    assert files(lab) == first


def test_a_run_that_fails_leaves_another_s_results(lab):
    assert main(COMMANDS["identify"]) == 0
    kept = files(lab)
    (lab / "bad.csv").write_text("t,x\n0,1\n")
    assert main(["identify", "bad.csv", *HAND, "--json", "out.json"]) == 2
    (lab / "bad.csv").unlink()
    assert files(lab) == kept
    assert json.loads(kept["out.json"])["format"] == "hmmseg.identify/1"
