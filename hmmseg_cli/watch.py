"""`hmmseg watch`: a recording as it comes on standard input, one line of JSON a row."""

from __future__ import annotations

import contextlib
import gc
import math
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
    "--lag", metavar="S", min=0.0, help="How long a boundary is waited for [s].")]  # fmt: skip
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
        _warm_up(task, rig, lag)
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


def _warm_up(task: Any, rig: Any, lag: float) -> None:
    """Load what is compiled before the first row comes."""
    import numpy as np

    from hmmseg.online.watcher import Watcher

    scratch = Watcher(task, rig, lag)
    names, hand = scratch.channels, scratch.filter.rig
    gripper = hand.gripper
    for i in range(200):
        values = np.zeros(len(names)) + 1e-4 * (i % 3)
        if gripper is not None:  # moves, closes and stands
            for name in gripper.position.values():
                values[names.index(name)] = 0.01 * math.sin(0.1 * i)
            for name in gripper.wrench[:3]:
                values[names.index(name)] = -(0.1**2) * math.sin(0.1 * i) * 25
            for name in gripper.opening:
                values[names.index(name)] = max(0.03, min(0.06, 0.06 - 0.004 * (i - 100)))
            if gripper.quaternion is not None:
                values[names.index(gripper.quaternion[3])] = 1.0
        elif not hand.jointed:
            values[names.index("x2")] = 0.05
        with contextlib.suppress(InputError):  # made-up rows need not tell how a sensor is mounted
            scratch.update(0.02 * i, values).line()
    with contextlib.suppress(InputError):
        scratch.finish().line()
