"""Recordings segmented apart: the same digits from any number of workers and from a cluster."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusals import refused

from hmmseg.example import example_folder
from hmmseg_cli import batch
from hmmseg_cli.batch import recordings_in, segment_apart
from hmmseg_cli.main import main

STACK = Path(__file__).parents[1] / "data/stack"
TRIALS = sorted(STACK.glob("trial_*.csv"))[:3]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    lab = tmp_path_factory.mktemp("lab")
    shutil.copyfile(example_folder() / "task.toml", lab / "task.toml")
    shutil.copyfile(STACK / "rig.toml", lab / "rig.toml")
    (lab / "many").mkdir()
    for i in range(6):  # more than a worker takes at once; no two of them the same
        lines = TRIALS[i % len(TRIALS)].read_text().splitlines(keepends=True)
        (lab / f"many/{i}.csv").write_text("".join(lines[: len(lines) - i]))
    (lab / "many/notes.txt").write_text("of the day")
    return lab


@pytest.fixture(scope="module")
def one(made):
    return segmented(made, "--workers", "1")


@pytest.fixture
def lab(made, monkeypatch):
    monkeypatch.chdir(made)
    return made


def segmented(lab, *arguments, trials="many"):
    """The JSON of a process: workers start from a program of its own, as users' do."""
    command = [sys.executable, "-W", "error", "-m", "hmmseg_cli.main", "segment", trials, "--task",
               "task.toml", "--rig", "rig.toml", "--json", "out.json", "--quiet", *arguments]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, cwd=lab)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads((lab / "out.json").read_text())


def test_digits_depend_neither_on_who_works_nor_on_the_order_of_a_set_of_names(lab, one):
    assert segmented(lab, "--workers", "2") == one
    assert [Path(t["file"]).as_posix() for t in one["trials"]] == [f"many/{i}.csv" for i in range(6)]
    alone = segmented(lab, trials="many/5.csv")["trials"]  # as without workers
    assert alone == one["trials"][5:]
    found = set()
    for seed in ("0", "1"):
        command = [sys.executable, "-m", "hmmseg_cli.main", "segment", "many/0.csv", "--task", "task.toml",
                   "--rig", "rig.toml", "--json", "-", "--quiet"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, env=os.environ | {"PYTHONHASHSEED": seed})
        found.add(done.stdout)
    assert len(found) == 1


def test_a_cluster_finds_the_same(lab, one):
    pytest.importorskip("dask.distributed", reason="dask is not installed (extra cluster)")
    assert segmented(lab, "--scheduler", "local", "--workers", "2") == one


def test_bad_recordings_folders_and_plain_sequences_are_told_in_a_line(lab, capfd, tmp_path):
    (tmp_path / "bad.csv").write_text("t,x1\n0,1\n")
    arguments = ["--task", "task.toml", "--rig", "rig.toml", "--json", f"{tmp_path}/out.json"]
    assert main(["segment", "many/0.csv", f"{tmp_path}/bad.csv", *arguments, "--workers", "2"]) == 2
    assert "bad.csv: " in (said := capfd.readouterr().err) and said.count("\n") == 1
    assert not (tmp_path / "out.json").exists()
    (lab / "order.toml").write_text('sequence = ["approach", "press"]\n')
    assert main(["segment", "many", "--task", "order.toml", "--workers", "2"]) == 2
    assert "go with tasks of blocks alone" in capfd.readouterr().err
    ((pile := tmp_path / "pile") / "inner").mkdir(parents=True)
    for name in ("b.csv", "a.CSV", "rig.toml", "c.npz"):
        (pile / name).touch()
    found = recordings_in([pile / "b.csv", pile])
    assert [p.name for p in found] == ["b.csv", "a.CSV", "b.csv", "c.npz"]
    refused("no recordings in this folder", recordings_in, [pile / "inner"])


@pytest.mark.parametrize(("more", "said"), [
    (["--workers", "1", "--figures", "f"], "--workers, --scheduler: go with --json alone"),
    (["--workers", "1", "--method", "qualitative"], "--workers, --scheduler: go with --json alone"),
    (["--workers", "0"], "Invalid value for '--workers'"),
    (["--scheduler", "nowhere"], "--scheduler nowhere: no scheduler answers there"),
    (["--workers", "1", "--force-threshold", "0.1"], "go only with the paper's thresholds"),
    (["--workers", "1", "--write", "labelled.txt"], "--write labelled.txt: unknown kind of file"),
])  # fmt: skip
def test_refusals(lab, more, said, capfd, monkeypatch):
    monkeypatch.setattr("hmmseg_cli.batch.PATIENCE", 0.5)
    if "--scheduler" in more:
        pytest.importorskip("dask.distributed", reason="dask is not installed (extra cluster)")
    assert main(["segment", "many", "--task", "task.toml", "--rig", "rig.toml", *more]) == 2
    assert said in capfd.readouterr().err


class Deadly(Executor):
    """An executor whose process dies with a recording of this name, and with it all that waits."""

    def __init__(self, name, deaths, error):
        self.name, self.deaths, self.error, self.broken = name, deaths, error, False

    def submit(self, function, path, *lab):
        future = Future()
        if self.deaths and self.name == path.stem:
            self.deaths.pop()
            self.broken = True
        if self.broken:
            future.set_exception(self.error)
        else:
            future.set_result(SimpleNamespace(segmentation=str(path)))
        return future


class KilledWorker(Exception):
    """As Dask names it."""


KilledWorker.__module__ = "distributed.scheduler"


@pytest.mark.parametrize("moment", [1.0, 2.0, 3.5])
def test_ctrl_c_ends_all_workers_without_a_traceback(lab, moment):
    command = [sys.executable, "-m", "hmmseg_cli", "segment", "many", "--task", "task.toml", "--rig",
               "rig.toml", "--json", "stopped.json", "--workers", "2"]  # fmt: skip
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
    running = subprocess.Popen(command, stdout=-1, stderr=-1, text=True, start_new_session=True)
    signal.signal(signal.SIGINT, before)
    time.sleep(moment)
    if running.poll() is None:  # else a quick machine is done
        os.killpg(running.pid, signal.SIGINT)
    _, err = running.communicate(timeout=60)
    stopped = running.returncode in (130, -signal.SIGINT)
    assert (stopped and not err) or (running.returncode == 0 and moment > 1)
    assert (lab / "stopped.json").exists() != stopped


@pytest.mark.parametrize("error", [BrokenProcessPool(), CancelledError(), KilledWorker()])
@pytest.mark.parametrize(("times", "lost"), [(1, ()), (2, (6,))])
def test_a_recording_whose_worker_is_killed_is_done_again_or_left_out(error, times, lost, monkeypatch):
    deaths = list(range(times))

    @contextmanager
    def executor(workers, scheduler):
        yield Deadly("6", deaths, error)

    monkeypatch.setattr(batch, "_executor", executor)
    monkeypatch.setattr(batch, "replace", lambda _, **new: new.get("file") or SimpleNamespace(**new))
    paths, said, done = [Path(f"{i}.csv") for i in range(11)], [], []
    found = list(segment_apart(paths, Path("task"), Path("rig"), 2, None, done.append, said.append))
    assert [Path(f.segmentation).stem for f in found] == [str(i) for i in range(11) if i not in lost]
    assert sum(done) == 11 and sum("6.csv: the process" in s for s in said) == len(lost)
    assert "once more" in said[0]
