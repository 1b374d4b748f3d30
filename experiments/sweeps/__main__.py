"""Run the robustness sweeps: `python -m experiments.sweeps [--small] [--workers N | --scheduler A]`.

Run it from the repository's root; workers of a cluster must be able to import the repository.
Interrupted, it goes on where it stopped. Writes experiments/results/sweeps/ and docs/sweeps.md.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from experiments.sweeps.cells import units
from experiments.sweeps.measure import measure
from experiments.sweeps.results import write_results
from experiments.sweeps.runner import run_sweep
from experiments.sweeps.store import Store
from experiments.sweeps.tables import fill

ROOT = Path(__file__).resolve().parents[2]


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what is not done yet, then summarise all of it."""
    options = _parser().parse_args(arguments)
    store = Store(options.store)
    if options.fresh:
        store.clear()
    work = units(options.small)
    if not options.summarise:
        with _executor(options.scheduler, options.workers) as executor, _bar() as progress:
            run_sweep(work, measure, executor, store, progress)
    name = "small.json" if options.small else "full.json"
    path = write_results(work, store, ROOT / "experiments/results/sweeps" / name)
    print(f"wrote {path.relative_to(ROOT)}")
    if not options.small:
        fill(ROOT / "docs/sweeps.md", path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments.sweeps", description=__doc__)
    parser.add_argument("--small", action="store_true", help="a few cells of 16 trials each")
    parser.add_argument("--workers", type=int, default=1, help="processes of this machine (default 1)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask cluster's, as tcp://host:8786")
    parser.add_argument("--store", type=Path, default=ROOT / "build/sweeps", help="where finished units lie")
    parser.add_argument("--fresh", action="store_true", help="forget what was done before")
    parser.add_argument("--summarise", action="store_true", help="run nothing, only summarise")
    return parser


@contextmanager
def _executor(scheduler: str | None, workers: int) -> Iterator[Executor]:
    """Processes of this machine, or a cluster's workers."""
    if scheduler is None:
        pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        from dask.distributed import Client
    except ImportError:
        raise SystemExit("--scheduler needs Dask: pip install 'hmmseg[cluster]'") from None
    with Client(scheduler) as client:
        yield client.get_executor()


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None]]:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as shown:
        task = shown.add_task("sweeps", total=None)
        yield lambda done, of: shown.update(task, completed=done, total=of)


if __name__ == "__main__":
    main()
