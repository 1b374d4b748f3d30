"""`hmmseg watch`: follow a recording on standard input, with one line of JSON per row."""

from __future__ import annotations

import gc
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live as RichLive
from rich.table import Table
from rich.text import Text

import hmmseg
from hmmseg.errors import InputError
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output
from hmmseg_cli.inspect import sparkline

if TYPE_CHECKING:
    from hmmseg.online.answer import Answer
    from hmmseg.online.watcher import Watcher
    from hmmseg_cli.rows import Rows

COUNTED = {
    "gaps": "gaps between rows", "late": "late rows put in their place",
    "repeated": "repeated rows counted once",
    "too late": "rows later than the lag left out", "contradictory": "second rows for one time left out",
    "bad": "rows that cannot be read left out",
}  # fmt: skip


def watch(
    task: opt.Task, rig: opt.Rig, lag: opt.Lag = 1.0, plot: opt.Plot = False,
    skip_bad_rows: opt.SkipBadRows = False, json: opt.Json = None, seed: opt.UnusedSeed = 0,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Follow a task while it runs: a CSV header then rows on standard input, one JSON line out per row."""
    from hmmseg.online.watcher import Watcher
    from hmmseg_cli.rows import Rows

    destination = None if json == "-" else json  # standard output has the lines, the last one included
    with Output("watch", json=destination, seed=seed, quiet=quiet) as out:
        watcher = Watcher(task, rig, lag)
        rows = Rows(sys.stdin.buffer, watcher)
        _warm_up(watcher)
        show = Live(watcher) if plot else None
        write = None if plot and sys.stdout.isatty() else out.write
        try:
            _follow(watcher, rows, write, show, skip_bad_rows, out)
        finally:
            gc.enable()
            if show is not None:
                show.close()
        final = watcher.finish()
        if watcher.filter.rig.fingertip.model_fields_set < {"normal_stiffness", "shear_stiffness"}:
            out.warn("the rig states no [fingertip] stiffness: heights and widths are off by what the pads "
                     "give, and boundaries with them; hmmseg segment and identify estimate it")  # fmt: skip
        counts = {key: count for key in COUNTED if (count := watcher.counts[key])}
        out.warn(*rows.notes, *(f"{count} {COUNTED[key]}" for key, count in counts.items()))
        envelope = {"format": "hmmseg.watch/1", "version": hmmseg.__version__, "seed": seed,
                    "warnings": out.warnings, "figures": [], "counts": dict(watcher.counts)}  # fmt: skip
        line = final.line(envelope)
        if write is not None:
            write(line + "\n")
        if destination is not None or out.lost:
            import json as jsonlib

            out.finish(jsonlib.loads(line))


def _follow(
    watcher: Watcher, rows: Rows, write: Callable[[str], None] | None, show: Live | None, skip: bool,
    out: Output,
) -> None:  # fmt: skip
    """Answer row after row until the stream ends, or nobody reads any more."""
    gc.collect()
    gc.freeze()
    gc.disable()  # nothing here makes cycles, and a collection would delay a row
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
            if out.lost and out.json is None:  # no reader is left, and no file to write
                return
        if show is not None:
            show.update(answer)


def _warm_up(watcher: Watcher) -> None:
    """Compile and import everything before the first row."""
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


REFRESH = 0.1  # look: s between pictures; a terminal shows no more
WIDTH = 60  # numerics: points of a signal
SECONDS = 10.0  # look: that a signal spans


class Live:
    """The display in the terminal."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher, self._shown = watcher, 0.0
        self._kept: deque[tuple[float, float, float]] = deque(maxlen=WIDTH)
        self._notes: deque[str] = deque(maxlen=3)
        self._console = Console(stderr=True)
        self._live = RichLive(console=self._console, auto_refresh=False, redirect_stdout=False)
        self._live.start()
        self._last: Answer | None = None

    def update(self, answer: Answer) -> None:
        """Take one answer, and redraw if it is time to."""
        if answer.note is not None:
            self._notes.append(f"{answer.t:.2f} s  {answer.note}")
        if not self._kept or answer.t >= self._kept[-1][0] + SECONDS / WIDTH:
            self._kept.append((answer.t, *self._watcher.forces))
        self._last = answer
        now = time.monotonic()
        if now - self._shown >= REFRESH:
            self._shown = now
            self._draw(answer)

    def close(self) -> None:
        """Leave the last picture on the screen."""
        if self._last is not None:
            self._draw(self._last)
        self._live.stop()

    def _draw(self, answer: Answer) -> None:
        self._live.update(picture(self._watcher, answer, list(self._kept), list(self._notes)), refresh=True)


def picture(
    watcher: Watcher, answer: Answer, kept: Sequence[tuple[float, float, float]], notes: Sequence[str]
) -> Group:
    """Bars of the subtasks, grip and net vertical force, properties and notes."""
    step, then, failed = answer.subtask, answer.next, answer.failed
    fits = Text("fits its task", "green")
    if failed is not None:
        fits = Text(f"does not fit its task at {failed['subtask']}: {failed['reason']}", "bold red")
    after = "end" if then is None else then.label
    head = Text.assemble((f"{answer.t:9.2f} s  ", "bold"), (step.label, "bold cyan"),
                         f"  next: {after}  ", fits)  # fmt: skip
    bars = Table.grid(padding=(0, 1))
    for k, (s, p) in enumerate(zip(watcher.filter.steps, answer.probabilities.tolist(), strict=True)):
        start = next((f"{c.t:.3f} ± {c.sd:.3f} s" for c in reversed(watcher.crossings) if c.step is s), "")
        style = "cyan" if k == answer.index else "dim"
        bars.add_row(Text(f"{s.name} {s.object}", style), Text("█" * round(20 * p), style),
                     f"{p:.2f}" if p > 0.005 else "", Text(start, "dim"))  # fmt: skip
    known = Table("", "mean", "sd", "unit", box=None, header_style="dim")
    for name, prop, mean, sd in answer.properties:
        scale, unit = (1.0, "N") if prop == "weight" else (100.0, "cm")
        known.add_row(f"{name} {prop}", f"{mean * scale:.3f}", f"{sd * scale:.3f}", unit)
    grip, lifting = spark([g for _, g, _ in kept]), spark([y for *_, y in kept])
    signals = Group(Text("grip    " + grip), Text("lifting " + lifting))
    return Group(head, Columns([bars, known]), signals, *[Text(note, "yellow") for note in notes])


def spark(values: Sequence[float]) -> str:
    """Forces [N] as a row of bars from 0 or less, blank where missing, with their maximum."""
    there = [v for v in values if math.isfinite(v)]
    return f"{sparkline((0.0, *values))[1:]} {max(there):.2f} N at most" if there else ""
