"""`hmmseg watch`: a recording as it comes on standard input, one line of JSON a row."""

from __future__ import annotations

import gc
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

import hmmseg
from hmmseg.errors import InputError
from hmmseg_cli.console import JsonOption, Output, QuietOption, RigOption, TaskOption, UnusedSeed

if TYPE_CHECKING:
    from hmmseg.online.watcher import Watcher
    from hmmseg_cli.rows import Rows

LagOption = Annotated[float, typer.Option(
    "--lag", metavar="S", min=0.0, help="How long to wait before a boundary is settled [s].")]  # fmt: skip
PlotOption = Annotated[bool, typer.Option(
    "--plot", help="Show it live in the terminal (standard error).")]  # fmt: skip
SkipOption = Annotated[bool, typer.Option(
    "--skip-bad-rows", help="Leave out rows that cannot be read, instead of stopping.")]  # fmt: skip
SAID = {
    "gaps": "gaps between rows", "late": "late rows put in their place",
    "repeated": "repeated rows counted once",
    "too late": "rows later than the lag left out", "contradictory": "second rows for one time left out",
    "bad": "rows that cannot be read left out",
}  # fmt: skip


def watch(
    task: TaskOption, rig: RigOption, lag: LagOption = 1.0, plot: PlotOption = False,
    skip_bad_rows: SkipOption = False, json: JsonOption = None, seed: UnusedSeed = 0,
    quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Follow a task while it runs: a CSV header then rows on standard input, one JSON line out per row."""
    from hmmseg.online.watcher import Watcher
    from hmmseg_cli.rows import Rows

    destination = None if json == "-" else json  # standard output has the lines, the last one included
    with Output("watch", json=destination, seed=seed, quiet=quiet) as out:
        watcher = Watcher(task, rig, lag)
        rows = Rows(sys.stdin.buffer, watcher)
        _warm_up(watcher)
        show = None
        if plot:
            from hmmseg_cli.live import Live

            show = Live(watcher, lines=not sys.stdout.isatty())
        write = out.write if show is None or show.lines else None
        try:
            _follow(watcher, rows, write, show, skip_bad_rows, out)
        finally:
            gc.enable()
            if show is not None:
                show.close()
        final = watcher.finish()
        for key, text in SAID.items():
            if watcher.counts[key]:
                out.warn(f"{watcher.counts[key]} {text}")
        envelope = {"format": "hmmseg.watch/1", "version": hmmseg.__version__, "seed": seed,
                    "warnings": out.warnings, "figures": [], "counts": dict(watcher.counts)}  # fmt: skip
        line = final.line(envelope)
        if write is not None:
            write(line + "\n")
        if destination is not None or out.lost:
            import json as jsonlib

            out.finish(jsonlib.loads(line))


def _follow(watcher: Watcher, rows: Rows, write: Any, show: Any, skip: bool, out: Output) -> None:
    gc.collect()
    gc.freeze()
    gc.disable()  # nothing here makes cycles, and a collection would hold up a row
    while True:
        try:
            row = rows.next()
        except InputError as error:
            if not skip:
                raise
            watcher.counts["bad"] += 1
            out.warn(str(error))
            continue
        except KeyboardInterrupt:
            return
        if row is None:
            return
        answer = watcher.update(*row)
        if write is not None:
            write(answer.line() + "\n")
            if out.lost and out.json is None:  # nobody reads, and there is nothing else to write
                return
        if show is not None:
            show.update(answer)


def _warm_up(watcher: Watcher) -> None:
    """Load what is compiled, or slow to import, before the first row comes."""
    import numpy as np

    from hmmseg.online.filter import Filter

    f = watcher.filter
    size = 12
    if f.rig.gripper is not None:
        import scipy.ndimage
        import scipy.spatial.transform  # noqa: F401

        size = 16
    scratch = Filter(f.task, f.rig, f.lag)
    for i in range(200):
        scratch.take(0.02 * i, np.full(size, 1e-4 * (i % 3)))
        scratch.answer().line()
    scratch.finish().line()
