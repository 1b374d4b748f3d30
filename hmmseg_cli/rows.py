"""Rows of CSV on a stream: separators, decimal commas, comments, units and ISO stamps as files have them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, BinaryIO

from hmmseg.errors import InputError, nearest
from hmmseg.io.formats.delimited import COMMENTS, SPACES, cells_of, separator_of, units_of
from hmmseg.io.table import check_unique
from hmmseg.io.units import LARGEST, LATEST, si_factor

if TYPE_CHECKING:
    from hmmseg.online.watcher import Watcher

WHERE = "standard input"
COMMENT = tuple(sign.encode() for sign in COMMENTS)


def _text(line: bytes) -> str:
    """A header as the spreadsheets of western Europe write it, or in UTF-8."""
    try:
        return line.decode("utf-8-sig")
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


class Rows:
    """Rows of a CSV stream as (t, channels in SI units); `next` gives None at its end.

    InputError names the header's column or the row at fault, rows counted as an editor does.
    """

    def __init__(self, stream: BinaryIO, watcher: Watcher) -> None:
        from hmmseg.io.units import Column, source_of

        self._stream, self._number = stream, 0
        header = _text(self._line()).strip()
        if not header:
            raise InputError(WHERE, "is empty", "a CSV header with a column t, then rows")
        self._separator = separator_of(header)
        self._between = None if self._separator == SPACES else self._separator
        self._first = True
        self._start: datetime | None = None  # of ISO stamps
        names = [name.strip() for name in cells_of(header, self._separator)]
        check_unique(names, WHERE)
        self._num, self._names, self._picked, self._scales = len(names), names, [], []
        self._unstated: list[int] = []  # of what the rig says no unit
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
            if entry.unit is None:
                self._unstated.append(len(self._picked) - 1)
        self._plain = self._is_plain()

    def next(self) -> tuple[float, Sequence[float]] | None:
        """The next row; None at the end of the stream."""
        line = self._line()
        if not line:
            return None
        cells = line.decode("ascii", "replace").rstrip("\r\n").split(self._between)
        if self._first:
            self._first = False
            if self._take_units(cells_of(_text(line).rstrip("\r\n"), self._separator)):
                return self.next()
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
            if abs(value) > (LARGEST if i else LATEST):
                where = f"{WHERE}: row {self._number}, column {self._names[self._picked[i]]}"
                if not i:
                    raise InputError(where, f"{value:.3g} is no time", "a time in s")
                problem = f"{value:.3g} is no reading of a hand's sensor"
                raise InputError(where, problem, f"at most {LARGEST:.0g} in SI units")
        return values[0], values[1:]

    def _line(self) -> bytes:
        """The next line that is no comment and not empty; nothing at the stream's end."""
        while line := self._stream.readline():
            self._number += 1
            if line.strip() and not line.lstrip().startswith(COMMENT):
                break
        return line

    def _take_units(self, cells: list[str]) -> bool:
        """Whether a first row holds the columns' units, which then count where the rig says none."""
        units = units_of(self._names, cells)
        for at in self._unstated if units else ():
            unit = units.get(self._names[self._picked[at]])
            if unit is not None:
                self._scales[at] = (self._scales[at][0] * si_factor(unit), self._scales[at][1])
        self._plain = self._is_plain()
        return bool(units)

    def _is_plain(self) -> bool:
        return all(scale == (1.0, 0.0) for scale in self._scales) and -1 not in self._picked

    def _number_in(self, cells: list[str], i: int) -> float:
        if i < 0:
            return math.nan
        text = cells[i].strip().strip('"')
        if not text:
            return math.nan
        if self._separator != "," and "." not in text:
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            if i == self._picked[0] and text[:4].isdigit():
                return self._seconds(i, cells, text)
            raise self._wrong(i, cells) from None

    def _seconds(self, i: int, cells: list[str], text: str) -> float:
        """An ISO 8601 stamp as s since the first."""
        try:
            stamp = datetime.fromisoformat(text)
        except ValueError:
            raise self._wrong(i, cells) from None
        if self._start is None:
            self._start = stamp
        if (stamp.tzinfo is None) != (self._start.tzinfo is None):
            raise self._wrong(i, cells)
        return (stamp - self._start).total_seconds()

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
