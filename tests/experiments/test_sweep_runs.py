"""The sweep runner: nothing lost, nothing repeated, whatever breaks on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.sweeps.cells import CHUNK, Cell, Unit
from experiments.sweeps.runner import SweepFailed, run_sweep
from experiments.sweeps.store import Store

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Square:
    """A unit whose work is to square a number."""

    number: int

    @property
    def key(self) -> str:
        return f"square.{self.number:04d}"


SQUARES = [Square(k) for k in range(12)]


class Counting:
    """Work that counts how often each unit was done and may fail at one."""

    def __init__(self, fails_at: int | None = None):
        self.calls: Counter[int] = Counter()
        self.fails_at = fails_at

    def __call__(self, unit: Square) -> dict:
        self.calls[unit.number] += 1
        if unit.number == self.fails_at:
            raise RuntimeError("this one")
        return {"square": unit.number**2}


def all_there(store: Store) -> bool:
    return store.finished() == {s.key for s in SQUARES} and all(
        store.read(s.key) == {"square": s.number**2} for s in SQUARES
    )


def test_every_unit_is_done_once_and_a_second_run_repeats_none(tmp_path):
    work, store, seen = Counting(), Store(tmp_path), []
    with ThreadPoolExecutor(3) as executor:
        assert run_sweep(SQUARES, work, executor, store, lambda *now: seen.append(now)) == 12
        assert run_sweep(SQUARES, work, executor, store) == 0
    assert all_there(store)
    assert set(work.calls.values()) == {1}
    assert seen == [(k, 12) for k in range(13)]


def test_a_failing_unit_stops_no_other_and_is_the_only_one_done_again(tmp_path):
    store, first, second = Store(tmp_path), Counting(fails_at=5), Counting()
    with ThreadPoolExecutor(2) as executor:
        with pytest.raises(
            SweepFailed, match=r"1 units failed.*square\.0005: RuntimeError: this one"
        ) as raised:
            run_sweep(SQUARES, first, executor, store)
        assert set(raised.value.failures) == {"square.0005"}
        assert len(store.finished()) == 11
        run_sweep(SQUARES, second, executor, store)
    assert second.calls == {5: 1}
    assert all_there(store)


def test_interrupted_it_keeps_what_is_finished_and_goes_on_there(tmp_path):
    store, work = Store(tmp_path), Counting()

    def interrupt(done: int, of: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        run_sweep(SQUARES, work, executor, store, interrupt)
    kept = store.finished()
    assert len(kept) == 4
    again = Counting()
    with ThreadPoolExecutor(1) as executor:
        run_sweep(SQUARES, again, executor, store)
    assert {f"square.{n:04d}" for n in again.calls} == {s.key for s in SQUARES} - kept
    assert all_there(store)


def test_two_units_of_one_key_are_refused(tmp_path):
    with ThreadPoolExecutor(1) as executor, pytest.raises(ValueError, match=r"share the key 'square\.0003'"):
        run_sweep([*SQUARES, Square(3)], Counting(), executor, Store(tmp_path))


KILLED = """
import sys, time
from pathlib import Path
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from experiments.sweeps.runner import run_sweep
from experiments.sweeps.store import Store

@dataclass(frozen=True)
class Square:
    number: int
    @property
    def key(self):
        return f"square.{self.number:04d}"

def work(unit):
    time.sleep(0.1)
    return {"square": unit.number ** 2}

with ThreadPoolExecutor(1) as executor:
    run_sweep([Square(k) for k in range(12)], work, executor, Store(Path(sys.argv[1])))
"""


def test_killed_outright_it_resumes(tmp_path):
    store = Store(tmp_path)
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], cwd=ROOT)
    deadline = time.monotonic() + 20
    while len(store.finished()) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = store.finished()
    assert 3 <= len(kept) < 12
    work = Counting()
    with ThreadPoolExecutor(1) as executor:
        run_sweep(SQUARES, work, executor, store)
    assert len(work.calls) == 12 - len(kept)
    assert all_there(store)


def test_a_file_appears_in_full_or_not_at_all(tmp_path, monkeypatch):
    store = Store(tmp_path)
    with pytest.raises(ValueError, match="JSON compliant"):
        store.write("bad", {"value": float("nan")})

    def power_cut(fd: int) -> None:
        raise OSError("power cut")

    monkeypatch.setattr(os, "fsync", power_cut)
    with pytest.raises(OSError, match="power cut"):
        store.write("half", {"value": list(range(1000))})
    assert store.finished() == set()
    monkeypatch.undo()
    readers, torn = threading.Event(), []

    def read_on() -> None:
        while not readers.is_set():
            if "k" in store.finished() and len(store.read("k")["value"]) != 5000:
                torn.append(True)

    reader = threading.Thread(target=read_on)
    reader.start()
    for _ in range(50):
        store.write("k", {"value": [1] * 5000})
    readers.set()
    reader.join()
    assert not torn
    assert store.finished() == {"k"}


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # a cluster that loses a worker warns of it
def test_a_cluster_that_loses_a_worker_loses_no_unit(tmp_path):
    distributed = pytest.importorskip("dask.distributed", reason="dask is not installed")
    log = tmp_path / "calls.txt"

    def work(unit):  # a local function travels by value
        import os
        import time

        with open(log, "a") as file:
            file.write(f"{os.getpid()} {unit.key}\n")
        time.sleep(0.15)
        return {"first": unit.first}

    plan = [Unit(Cell(), k * CHUNK) for k in range(12)]
    store, seen = Store(tmp_path / "store"), []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        assert len({*pids, os.getpid()}) == 3

        def kill_one(done: int, of: int) -> None:
            seen.append((done, of))
            if done == 4:
                os.kill(pids[0], signal.SIGKILL)

        run_sweep(plan, work, client.get_executor(), store, kill_one)
    assert store.finished() == {unit.key for unit in plan}
    assert all(store.read(unit.key) == {"first": unit.first} for unit in plan)
    assert seen == [(k, 12) for k in range(13)]
    done_by = {line.split()[0] for line in log.read_text().splitlines()}
    assert str(pids[0]) in done_by and str(pids[1]) in done_by
    again = Counting()
    with ThreadPoolExecutor(1) as executor:
        assert run_sweep(plan, again, executor, store) == 0
    assert not again.calls
