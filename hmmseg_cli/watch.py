"""`hmmseg watch`: a recording as it comes on standard input, one line of JSON a row."""

from __future__ import annotations

import contextlib
import gc
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import typer

import hmmseg
from hmmseg.errors import InputError, nearest
from hmmseg.io.units import LARGEST, si_factor
from hmmseg_cli.console import JsonOption, Output, QuietOption, RigOption, SeedOption, TaskOption

if TYPE_CHECKING:
    from hmmseg.online.watcher import Watcher

WHERE = "standard input"
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
    skip_bad_rows: SkipOption = False, json: JsonOption = None, seed: SeedOption = 0,
    quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Follow a task while it runs: a CSV header then rows on standard input, one JSON line out per row."""
    from hmmseg.online.watcher import Watcher

    destination = None if json == "-" else json  # standard output has the lines, the last one included
    with Output("watch", json=destination, seed=seed, quiet=quiet) as out:
        watcher = Watcher(task, rig, lag)
        rows = Rows(sys.stdin.buffer, watcher)
        _warm_up(task, rig, lag)
        show = None
        if plot:
            from hmmseg_cli.live import Live

            show = Live(watcher, lines=not sys.stdout.isatty())
        write = sys.stdout.write if show is None or show.lines else None
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
            sys.stdout.flush()
        if destination is not None:
            import json as jsonlib

            out.finish(jsonlib.loads(line))


def _follow(watcher: Watcher, rows: Rows, write: Any, show: Any, skip: bool, out: Output) -> None:
    flush = sys.stdout.flush
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
            flush()
        if show is not None:
            show.update(answer)


class Rows:
    """Rows of a CSV stream as (t, channels in SI units); `next` gives None at its end.

    InputError names the header's column or the row at fault, rows counted as an editor does.
    """

    def __init__(self, stream: BinaryIO, watcher: Watcher) -> None:
        from hmmseg.io.columns import Column, source_of

        self._stream, self._number = stream, 1
        header = stream.readline().decode("utf-8-sig", "replace").strip()
        if not header:
            raise InputError(WHERE, "is empty", "a CSV header with a column t, then rows")
        self._separator = max(",;\t", key=header.count)
        names = [name.strip().strip('"') for name in header.split(self._separator)]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{WHERE}: column {name}", "appears twice", "one of each name")
        self._num, self._names, self._picked, self._scales = len(names), names, [], []
        columns = watcher.filter.rig.columns
        for ours in ("t", *watcher.channels):
            theirs = source_of(ours, columns)
            if theirs not in names:
                if ours in watcher.optional and ours not in columns:
                    self._picked.append(-1)
                    self._scales.append((1.0, 0.0))
                    continue
                raise InputError(f"{WHERE}: column {theirs}", "missing", nearest(theirs, names))
            entry = columns.get(ours, Column())
            unit = 1.0 if entry.unit is None else si_factor(entry.unit)
            self._picked.append(names.index(theirs))
            self._scales.append((entry.sign * unit, entry.offset))
        self._plain = all(scale == (1.0, 0.0) for scale in self._scales) and -1 not in self._picked

    def next(self) -> tuple[float, Sequence[float]] | None:
        """The next row; None at the end of the stream."""
        while True:
            line = self._stream.readline()
            if not line:
                return None
            self._number += 1
            cells = line.decode("ascii", "replace").rstrip("\r\n").split(self._separator)
            if len(cells) > 1 or cells[0].strip():
                break
        if len(cells) != self._num:
            raise InputError(
                f"{WHERE}: row {self._number}", f"has {len(cells)} cells", f"{self._num} as in the header"
            )
        try:
            values = [float(cells[i]) for i in self._picked]
        except ValueError:
            values = [self._number_in(cells, i) for i in self._picked]
        if -1 in self._picked:
            values = [math.nan if i < 0 else v for i, v in zip(self._picked, values, strict=True)]
        if not math.isfinite(sum(values)):
            self._check(values, cells)
        if not self._plain:
            values = [s * v + o for v, (s, o) in zip(values, self._scales, strict=True)]
        for i, value in enumerate(values):
            if i and abs(value) > LARGEST:
                where = f"{WHERE}: row {self._number}, column {self._names[self._picked[i]]}"
                problem = f"{value:.3g} is no reading of a hand's sensor"
                raise InputError(where, problem, f"at most {LARGEST:.0g} in SI units")
        return values[0], values[1:]

    def _number_in(self, cells: list[str], i: int) -> float:
        text = cells[i].strip().strip('"')
        if not text:
            return math.nan
        try:
            return float(text)
        except ValueError:
            raise self._wrong(i, cells) from None

    def _wrong(self, i: int, cells: list[str]) -> InputError:
        found = cells[i].strip()[:60]
        return InputError(f"{WHERE}: row {self._number}, column {self._names[i]}",
                          f"{found!r} is not a finite number", "a number or an empty cell")  # fmt: skip

    def _check(self, values: list[float], cells: list[str]) -> None:
        if math.isnan(values[0]):
            column = self._names[self._picked[0]]
            raise InputError(f"{WHERE}: row {self._number}, column {column}", "missing", "a time in s")
        for i, value in zip(self._picked, values, strict=True):
            if math.isinf(value):
                raise self._wrong(i, cells)


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
