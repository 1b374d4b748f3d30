"""`hmmseg watch` row by row, and recordings segmented apart by any number of workers."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from refusals import refused
from rich.console import Console

from hmmseg import Watcher
from hmmseg.example import example_folder
from hmmseg_cli import batch
from hmmseg_cli.batch import recordings_in, segment_apart
from hmmseg_cli.main import main
from hmmseg_cli.watch import Live, picture, spark

CASE = Path(__file__).parents[2] / "recordings" / "paper_blocks"
ROWS = (CASE / "trial_01.csv").read_text().splitlines()
COMMAND = ["watch", "--task", str(CASE / "task.toml"), "--rig", str(CASE / "rig.toml")]


@pytest.fixture
def run(monkeypatch, capsys):
    def run(rows, *options, end="\n"):
        text = io.TextIOWrapper(io.BytesIO(("\n".join(rows) + end).encode()))
        monkeypatch.setattr(sys, "stdin", text)
        code = main([*COMMAND, *options])
        out, err = capsys.readouterr()
        return code, [json.loads(line) for line in out.splitlines()], err

    return run


def test_one_line_a_row_and_a_last_one_or_a_live_picture_of_where_the_task_is(run, tmp_path):
    code, lines, err = run(ROWS, "--json", str(tmp_path / "out.json"))
    assert code == 0 and err == ""
    assert len(lines) == len(ROWS)  # the header's place is taken by the last line
    assert [line["t"] for line in lines[:3]] == [0, 0.05, 0.1]
    assert lines[-1]["final"] and lines[-1]["fits"] and lines[-1]["format"] == "hmmseg.watch/1"
    assert [s["subtask"] for s in lines[-1]["segments"]][:3] == ["pregrasp", "pickup", "carry"]
    assert json.loads((tmp_path / "out.json").read_text())["segments"] == lines[-1]["segments"]
    watcher = Watcher(COMMAND[2], COMMAND[4])
    live = Live(watcher)
    live._console.file = io.StringIO()
    for row in ROWS[1:60]:
        t, *values = map(float, row.split(","))
        answer = watcher.update(t, values)
        live.update(answer)
    live.close()
    console = Console(file=io.StringIO(), width=140)
    console.print(picture(watcher, answer, list(live._kept), ["a note"]))
    text = console.file.getvalue()
    assert "carry block1" in text and "fits its task" in text and "a note" in text and "grip" in text
    assert spark([0.0, float("nan"), 2.0]) == "▁ █ 2.00 N at most"


@pytest.mark.parametrize(("change", "message"), [
    (lambda rows: [rows[0].replace("fx1", "fz1"), *rows[1:]], "column fx1: missing"),
    (lambda rows: [*rows[:5], rows[5].replace(",", ",x", 1), *rows[6:]], "row 6, column q11: 'x"),
    (lambda rows: [*rows[:5], "1,2,3", *rows[6:]], "row 6: has 3 cells; expected 13"),
    (lambda rows: [*rows[:5], "," + rows[5].split(",", 1)[1], *rows[6:]], "row 6, column t: missing"),
    (lambda rows: [], "standard input: is empty"),
    (lambda rows: rows[:1], "the stream: has no rows; expected a row for every sample"),
    (
        lambda rows: [*rows[:5], re.sub(",[^,]*$", ",1e300", rows[5]), *rows[6:]],
        "row 6, column fy2: 1e+300 is no")])  # fmt: skip
def test_bad_input_gets_one_line(run, change, message):
    code, _, err = run(change(ROWS[:10]))
    assert code == 2 and len(err.splitlines()) == 1 and message in err


def test_degrees_and_ms_are_refused_as_in_a_file(run):
    cells = [row.split(",") for row in ROWS[1:110]]
    angles = [k for k, name in enumerate(ROWS[0].split(",")) if name[0] in "qd"]
    rows = [",".join(str(57.3 * float(c)) if k in angles else c for k, c in enumerate(row)) for row in cells]
    code, _, err = run([ROWS[0], *rows])
    assert code == 2 and "it looks like deg; expected q" in err
    wild = [*ROWS[:60], ",".join([ROWS[60].split(",")[0], *["999"] * 12]), *ROWS[61:110]]
    assert run(wild)[0] == 0  # a single row is no unit
    cells = [row.split(",", 1) for row in ROWS[1:110]]
    rows = [f"{1e3 * float(t):g},{rest}" for t, rest in cells]
    code, _, err = run([ROWS[0], *rows])
    assert code == 2 and "it looks like ms; expected t = {" in err and 'unit = "ms"' in err
    assert run([*ROWS[:50], *ROWS[90:150]])[0] == 0  # a gap is no unit


def test_a_stream_as_a_spreadsheet_has_it(run):
    plain, table = run(ROWS[:60])[1], [row.split(",") for row in ROWS[:60]]
    units = ["" if name == "t" else "N" if name[0] == "f" else "rad/s" if name[0] == "d" else "rad"
             for name in table[0]]  # fmt: skip
    start = datetime.fromisoformat("2026-03-02T10:15:30+01:00")
    rows = ["# Versuch 3", ";".join(table[0]), ";".join(units), ""]
    for cells in table[1:]:
        stamp = (start + timedelta(seconds=float(cells[0]))).isoformat()
        rows += [";".join([stamp, *(cell.replace(".", ",") for cell in cells[1:])]), "% weiter"]
    code, lines, err = run(rows)
    assert (code, err) == (0, "")
    assert [line["probabilities"] for line in lines] == [line["probabilities"] for line in plain]
    assert lines[30]["t"] == pytest.approx(plain[30]["t"])
    code, _, err = run([*rows[:10], rows[10].replace("2026", "morgen"), *rows[11:]])
    assert code == 2 and "column t: 'morgen" in err


@pytest.mark.parametrize("left_out", [r"\[fingertip\][^\[]*", r"(?m)^(normal|shear)_stiffness.*$"])
def test_a_rig_without_pads_is_told(run, tmp_path, left_out):
    (tmp_path / "rig.toml").write_text(re.sub(left_out, "", (CASE / "rig.toml").read_text()))
    code, lines, _ = run(ROWS[:20], "--rig", str(tmp_path / "rig.toml"))
    assert code == 0 and any("states no [fingertip]" in line for line in lines[-1]["warnings"])


def test_bad_rows_and_one_that_breaks_off_can_be_left_out(run):
    rows = [*ROWS[:5], "garbage", *ROWS[5:20]]
    code, lines, err = run(rows, "--skip-bad-rows")
    assert code == 0 and len(lines) == 20 and "row 6: has 1 cells" in err and lines[-1]["counts"]["bad"] == 1
    code, lines, err = run([*ROWS[:20], ROWS[20][:30]], end="")
    assert code == 0 and len(lines) == 20 and lines[-1]["final"] and lines[-1]["counts"]["rows"] == 19
    assert lines[-1]["warnings"] == ["standard input: row 21, the last, is cut off and left out"]
    assert lines[-1]["warnings"][0] in err
    whole = run(ROWS[:20], end="")[1]
    assert whole[-1]["counts"] == lines[-1]["counts"] and whole[-1]["segments"] == lines[-1]["segments"]


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
    return segmented(made, "--workers", "1", seed="1")


@pytest.fixture
def lab(made, monkeypatch):
    monkeypatch.chdir(made)
    return made


def segmented(lab, *arguments, trials="many", seed="0"):
    """The JSON of a process: workers start from a program of its own, as users' do."""
    command = [sys.executable, "-W", "error", "-m", "hmmseg_cli.main", "segment", trials, "--task",
               "task.toml", "--rig", "rig.toml", "--json", "out.json", "--quiet", *arguments]  # fmt: skip
    environment = os.environ | {"PYTHONHASHSEED": seed}
    done = subprocess.run(command, capture_output=True, text=True, cwd=lab, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads((lab / "out.json").read_text())


def test_digits_depend_neither_on_who_works_nor_on_the_order_of_a_set_of_names(lab, one):
    assert segmented(lab, "--workers", "2") == one
    assert [Path(t["file"]).as_posix() for t in one["trials"]] == [f"many/{i}.csv" for i in range(6)]
    alone = segmented(lab, trials="many/5.csv")["trials"]  # as without workers
    assert alone == one["trials"][5:]


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
            future.set_result((str(path), (), ()))
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
    monkeypatch.setattr(batch, "replace", lambda _, file: file)
    paths, said, done = [Path(f"{i}.csv") for i in range(11)], [], []
    found = list(segment_apart(paths, Path("task"), Path("rig"), 2, None, done.append, said.append))
    assert [Path(file).stem for file, *_ in found] == [str(i) for i in range(11) if i not in lost]
    assert sum(done) == 11 and sum("6.csv: the process" in s for s in said) == len(lost)
    assert "once more" in said[0]
