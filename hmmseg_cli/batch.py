"""Segment many recordings, each by itself: in processes of this machine, or on a Dask cluster.

The result of a recording depends only on it, its task and its rig, not on the number of processes or their
order.
"""

import contextlib
import functools
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from hmmseg.errors import InputError
from hmmseg.io.formats import KINDS, kind_of
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.segmentation.spans import Segmentation

LOCAL = "local"
PATIENCE = 10.0  # limit: s to wait for a cluster
# Segmentation of one recording, with the warnings and notes of reading it.
Segmented = tuple[Segmentation, Sequence[str], Sequence[str]]


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """The paths, with plain folders replaced by the recordings in them, sorted; .txt files may be notes."""
    out, kinds = list[Path](), [kind for kind in KINDS if kind != ".txt"]
    for path in paths:
        inside = [path]
        if path.is_dir():
            with contextlib.suppress(InputError):  # a data set
                kind_of(path)
                out.append(path)
                continue
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in kinds and p.is_file())
        if not inside:
            raise InputError(str(path), "no recordings in this folder", ", ".join(kinds))
        out += inside
    return out


@functools.cache
def _lab(task: Path, rig: Path) -> tuple[BlockTask, Rig]:
    description = read_task(task)
    assert isinstance(description, BlockTask)
    return description, read_rig(rig)


def segment_one(path: Path, task: Path, rig: Path) -> Segmented:
    """Segment one recording by itself; runs in a worker."""
    from hmmseg.hand.read import read_trial
    from hmmseg.segmentation.align import segment

    description, hand = _lab(task, rig)
    trial = read_trial(path, hand)
    segmentation = replace(segment([trial], description, hand)[0], recorded=None)
    return segmentation, trial.warnings, trial.notes


def segment_apart(
    paths: Sequence[Path], task: Path, rig: Path, workers: int | None, scheduler: str | None,
    advance: Callable[[int], None], tell: Callable[[str], None],
) -> Iterator[Segmented]:  # fmt: skip
    """Results of `segment_one` in order; `advance` gets the number of further ones done. One whose worker is
    lost is segmented once more, then left out with a warning to `tell`. InputError for bad recordings."""
    left, lab = list(paths), (task.absolute(), rig.absolute())
    while left:
        with _executor(workers, scheduler) as executor:
            with _uninterrupted():  # processes start here
                futures = [executor.submit(segment_one, path.absolute(), *lab) for path in left]
            try:
                for future in futures:
                    path, found = left.pop(0), _unless_lost(future)
                    lost = found is None
                    if lost:
                        tell(f"{path}: its worker, or that of a recording near it, was lost; once more")
                        with _executor(1, None) as alone:
                            with _uninterrupted():
                                again = alone.submit(segment_one, path.absolute(), *lab)
                            found = _unless_lost(again)
                    advance(1)
                    if found is None:
                        tell(f"{path}: the process that segmented it was killed, twice; it is left out")
                    else:
                        yield replace(found[0], file=str(path)), *found[1:]
                    if lost:  # a pool is lost with any of its processes, and a cluster may be gone
                        scheduler = None
                        break
            finally:
                # A pool cancels its own: elsewhere, its thread would fail on them.
                for future in () if isinstance(executor, ProcessPoolExecutor) else futures:
                    future.cancel()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold interrupts back, in processes that start meanwhile as well, until `_end_silently`."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_silently() -> None:
    """Let an interrupt end this worker without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _unless_lost(future: Future[Segmented]) -> Segmented | None:
    """A worker's result; None if the worker was killed or its cluster is gone."""
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        return None
    except Exception as error:
        if type(error).__module__.partition(".")[0] == "distributed":  # KilledWorker, CommClosedError, ...
            return None
        raise


@contextmanager
def _executor(workers: int | None, scheduler: str | None) -> Iterator[Executor]:
    """Processes of this machine, or the workers of a cluster."""
    if scheduler is None:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_end_silently) as pool:
            try:
                yield pool
            finally:
                pool.shutdown(cancel_futures=True)
        return
    try:
        from dask.distributed import Client
    except ImportError:
        raise InputError("--scheduler", "needs Dask, which is not installed",
                         "pip install 'hmmseg[cluster]'") from None  # fmt: skip
    settings: dict[str, Any] = {"address": scheduler, "timeout": PATIENCE}
    if scheduler == LOCAL:
        settings = {"n_workers": workers or os.cpu_count(), "threads_per_worker": 1, "processes": True,
                    "dashboard_address": None, "silence_logs": logging.ERROR}  # fmt: skip
    try:
        client = Client(**settings)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}", "no scheduler answers there",
                         "an address as tcp://host:8786, or local") from error  # fmt: skip
    with client:
        yield client.get_executor()  # type: ignore[no-untyped-call]
