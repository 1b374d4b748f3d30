"""Rows of CSV from a stream, with the separators, decimal commas, comments, units and ISO stamps of files."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, BinaryIO

from hmmseg.errors import InputError, nearest
from hmmseg.io.formats.delimited import COMMENTS, SPACES, cells_of, check_header, separator_of, units_of
from hmmseg.io.table import check_unique
from hmmseg.io.units import LARGEST, LATEST, Column, si_factor, source_of

if TYPE_CHECKING:
    from hmmseg.online.watcher import Watcher

WHERE = "standard input"
COMMENT = tuple(sign.encode() for sign in COMMENTS)
TIME = LATEST, "time", "a time in s"
READING = LARGEST, "reading of a hand's sensor", f"at most {LARGEST:.0g} in SI units"


def _text(line: bytes) -> str:
    """Decode a header in UTF-8, or as spreadsheets in western Europe write it."""
    try:
        return line.decode("utf-8-sig")
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


class Rows:
    """Rows of a CSV stream as (t, channels in SI units); InputErrors name columns, and rows as editors do."""

    def __init__(self, stream: BinaryIO, watcher: Watcher) -> None:
        self._stream, self._number = stream, 0
        self.notes: list[str] = []  # about the end of the stream
        header = _text(self._line()).strip()
        if not header:
            raise InputError(WHERE, "is empty", "a CSV header with a column t, then rows")
        self._separator = separator_of(header)
        self._between = None if self._separator == SPACES else self._separator
        self._first = True
        self._start: datetime | None = None  # of ISO stamps
        names = [name.strip() for name in cells_of(header, self._separator)]
        check_header(names, WHERE)
        check_unique(names, WHERE)
        self._num, self._names, self._picked, self._scales = len(names), names, [], []
        self._unstated: list[int] = []  # channels without a unit in the rig
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
            self._picked.append(names.index(theirs))
            self._scales.append((entry.sign * entry.size, entry.offset))
            if entry.unit is None:
                self._unstated.append(len(self._picked) - 1)

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
        if len(cells) < self._num and not line.endswith((b"\n", b"\r")):
            self.notes.append(f"{WHERE}: row {self._number}, the last, is cut off and left out")
            return None
        if len(cells) != self._num:
            where = f"{WHERE}: row {self._number}"
            raise InputError(where, f"has {len(cells)} cells", f"{self._num} as in the header")
        try:
            values = [math.nan if i < 0 else float(cells[i]) for i in self._picked]
        except ValueError:
            values = [self._number_in(cells, i) for i in self._picked]
        if math.isnan(values[0]):
            raise InputError(self._cell(self._picked[0]), "missing", "a time in s")
        for i in (i for i, value in zip(self._picked, values, strict=True) if math.isinf(value)):
            raise self._wrong(i, cells)
        values = [s * v + o for v, (s, o) in zip(values, self._scales, strict=True)]
        for i, value in enumerate(values):
            limit, kind, most = READING if i else TIME
            if abs(value) > limit:
                raise InputError(self._cell(self._picked[i]), f"{value:.3g} is no {kind}", most)
        return values[0], values[1:]

    def _line(self) -> bytes:
        """The next line that is neither a comment nor empty; empty at the end of the stream."""
        while line := self._stream.readline():
            self._number += 1
            if line.strip() and not line.lstrip().startswith(COMMENT):
                break
        return line

    def _take_units(self, cells: list[str]) -> bool:
        """Whether a first row holds units, which then apply where the rig states none."""
        units = units_of(self._names, cells)
        for at in self._unstated if units else ():
            unit = units.get(self._names[self._picked[at]])
            if unit is not None:
                self._scales[at] = (self._scales[at][0] * si_factor(unit), self._scales[at][1])
        return bool(units)

    def _number_in(self, cells: list[str], i: int) -> float:
        """A cell that is empty, quoted, with a decimal comma, or an ISO stamp, in s since the first."""
        text = "" if i < 0 else cells[i].strip().strip('"')
        if not text:
            return math.nan
        if self._separator != "," and "." not in text:
            text = text.replace(",", ".")
        with contextlib.suppress(ValueError):
            return float(text)
        if i == self._picked[0] and text[:4].isdigit():
            with contextlib.suppress(ValueError, TypeError):  # TypeError: only one stamp has a zone
                stamp = datetime.fromisoformat(text)
                self._start = self._start or stamp
                return (stamp - self._start).total_seconds()
        raise self._wrong(i, cells)

    def _cell(self, i: int) -> str:
        return f"{WHERE}: row {self._number}, column {self._names[i]}"

    def _wrong(self, i: int, cells: list[str]) -> InputError:
        problem = f"{cells[i].strip()[:60]!r} is not a finite number"
        return InputError(self._cell(i), problem, "a number or an empty cell")
