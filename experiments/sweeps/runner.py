"""Units of work through any executor, resumable: threads, processes or a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from typing import Any, Protocol, TypeVar

from experiments.sweeps.store import Store


class Keyed(Protocol):
    """A unit of work with a name of its own, fit for a file name."""

    @property
    def key(self) -> str:
        """The unit's name."""
        ...


Unit = TypeVar("Unit", bound=Keyed)


class SweepFailed(RuntimeError):
    """Some units failed; `failures` maps their keys to what they raised. All others are stored."""

    def __init__(self, failures: dict[str, BaseException]) -> None:
        key, error = next(iter(failures.items()))
        super().__init__(f"{len(failures)} units failed; the first, {key}: {type(error).__name__}: {error}")
        self.failures = failures


def run_sweep(cells: Sequence[Unit], work: Callable[[Unit], Any], executor: Executor, store: Store,
              progress: Callable[[int, int], None] | None = None) -> int:  # fmt: skip
    """Do the `work` of every unit in `cells` that `store` has not; the number done now.

    `executor` is any of concurrent.futures' kind, a Dask client's too; `work` and the units must be
    picklable where it needs that. Only this process writes, once for each unit as it finishes, so a
    unit that a cluster had to do twice counts once. `progress(finished, of)` counts units, those of
    earlier runs included. Interrupted, it leaves what is finished in the store and cancels the
    rest. A unit that fails does not stop the others; SweepFailed names it at the end. ValueError
    where two units share a key.
    """
    keys = [unit.key for unit in cells]
    if len(set(keys)) != len(keys):
        raise ValueError(f"two units share the key {next(k for k in keys if keys.count(k) > 1)!r}")
    finished = store.finished()
    waiting = [unit for unit in cells if unit.key not in finished]
    done, failures = len(cells) - len(waiting), {}
    if progress is not None:
        progress(done, len(cells))
    futures: dict[Future, str] = {}
    try:
        for unit in waiting:
            futures[executor.submit(work, unit)] = unit.key
        for future in as_completed(futures):
            try:
                store.write(futures[future], future.result())
            except (Exception, CancelledError) as error:
                failures[futures[future]] = error
            else:
                done += 1
                if progress is not None:
                    progress(done, len(cells))
    finally:
        for future in futures:
            future.cancel()
    if failures:
        raise SweepFailed(failures)
    return len(waiting)
