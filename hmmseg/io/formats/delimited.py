"""Tables in text files.

Separators are commas, semicolons, tabs or runs of spaces, or named by a first line `sep=;`; decimals have
points, or commas where these do not separate cells; lines that begin with #, % or // are comments, and a
comment may be the header; a row of units may follow the header. A truncated last line is dropped, and so are
zero bytes at the end, which recorders leave when they are interrupted.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import MAX_COLUMNS, Table, check_unique
from hmmseg.io.units import known_unit

COMMENTS = ("#", "%", "//")
MAX_LINE = 10_000_000  # limit: bytes of the first line
SPACES = r"\s+"
STATED_SEPARATOR = re.compile(r"sep=(.)", re.IGNORECASE)  # first line of a spreadsheet's CSV
TEXT = frozenset(range(256)) - set(range(9)) - set(range(14, 32)) - {127}  # bytes that a text may have
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|NaN|inf|")
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclass(frozen=True)
class Layout:
    """The layout of one text file; line numbers count from 0."""

    encoding: str
    separator: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    skipped: frozenset[int]
    rows: np.ndarray
    most: int  # cells of the longest row; those beyond the names are empty
    notes: tuple[str, ...]  # what was dropped


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of a text file; rows are numbered by line, from 1."""
    import pandas as pd

    layout = find_layout(path)
    names = [name for name in layout.names if name]
    check_header(names, str(path))
    check_unique(names, str(path))
    chosen = [i for i, name in enumerate(layout.names) if name and (wanted is None or name in wanted)]
    frame = pd.read_csv(
        path, sep=layout.separator, decimal=layout.decimal, encoding=layout.encoding, header=None,
        names=list(range(layout.most)), usecols=chosen, index_col=False, skipinitialspace=True,
        skiprows=layout.skipped.__contains__, skip_blank_lines=False, low_memory=False,
    ) if chosen else pd.DataFrame(index=range(layout.rows.size))  # fmt: skip
    if len(frame) != layout.rows.size:
        raise InputError(str(path), f"{layout.rows.size} lines make {len(frame)} rows", "one line a row")
    kept = ~frame.isna().to_numpy().all(axis=1) if chosen else np.ones(len(frame), dtype=bool)
    columns, rows = {layout.names[i]: np.asarray(frame[i])[kept] for i in chosen}, layout.rows[kept] + 1
    for name, values in columns.items() if layout.decimal == "," else ():
        for i, cell in enumerate(values if values.dtype.kind == "O" else ()):
            if isinstance(cell, str) and "." in cell and NUMBER.fullmatch(cell.replace(",", "").strip()):
                raise InputError(f"{path}: row {rows[i]}, column {name}",  # ambiguous
                                 f"{cell} has a decimal point, others have commas", "one kind")  # fmt: skip
            if isinstance(cell, str) and COMMA_NUMBER.fullmatch(cell.strip()):
                values[i] = cell.replace(",", ".")  # so that errors name cells that are no numbers
    return Table(str(path), tuple(names), columns, rows, layout.units, notes=layout.notes)


def find_layout(path: Path) -> Layout:
    """Layout of a text file, with the number of cells in every row checked."""
    with path.open("rb") as file:
        start = file.readline(MAX_LINE)
    if len(start) == MAX_LINE:
        raise InputError(f"{path}: row 1", f"is longer than {MAX_LINE} bytes", "a table with a header row")
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        return _layout(path, encoding)
    except UnicodeDecodeError as error:
        start = error.object[: error.start + 1]
        if encoding != "utf-8-sig" or not set(start) < TEXT:
            raise
        return _layout(path, "cp1252")  # umlauts as written by spreadsheets in western Europe


def _layout(path: Path, encoding: str) -> Layout:
    separator, header = "", None
    comments: list[str] = []
    units: dict[str, str] = {}
    skipped: list[int] = []
    rows: list[int] = []
    notes: list[str] = []
    decimal, most, line = ".", 0, ""
    decimals: set[int] = set()  # decimal places at the ends of rows
    with path.open(encoding=encoding, newline="") as file:
        for number, line in enumerate(file):
            text = line.rstrip("\r\n").replace("\0", " ")
            stated = STATED_SEPARATOR.fullmatch(text.strip()) if header is None else None
            blank = not text.strip()
            if stated or blank or text.lstrip().startswith(COMMENTS):
                separator = stated.group(1) if stated else separator
                skipped.append(number)
                comments += [text] if header is None and not blank and not stated else []
                continue
            if header is None:
                separator = separator or separator_of(text)
                header = header_of(text, comments, separator)
                if header is None:
                    header = cells_of(text, separator)
                    skipped.append(number)
                while header and not header[-1].strip():  # trailing separators
                    header.pop()
                most = len(header)
                if most > MAX_COLUMNS:
                    raise InputError(str(path), f"has {most} columns", f"{MAX_COLUMNS} at most")
                if number in skipped[-1:]:
                    continue
            if text.count('"') % 2:
                raise InputError(f"{path}: row {number + 1}", "a quoted cell does not end", "one line a row")
            quick = '"' not in text and separator != SPACES
            cells = None if quick else cells_of(text, separator)
            found = text.count(separator) + 1 if cells is None else len(cells)
            if found != len(header):
                cells = cells_of(text, separator) if cells is None else cells
                cut = found < len(header) and not line.endswith(("\n", "\r"))
                if cut or not any(cell.strip() for cell in cells):
                    notes += [f"{path}: row {number + 1}, the last, is cut off and left out"] * cut
                    skipped.append(number)
                    continue
                if found < len(header) or any(cell.strip() for cell in cells[len(header) :]):
                    raise InputError(f"{path}: row {number + 1}", f"has {found} cells",
                                     f"{len(header)} as in the header")  # fmt: skip
                most = max(most, found)
            if not rows and not units and units_of(header, cells_of(text, separator)[: len(header)]):
                units = units_of(header, cells_of(text, separator)[: len(header)])
                skipped.append(number)
                continue
            if decimal == "." and separator != "," and "," in text:
                commas = any(COMMA_NUMBER.fullmatch(cell.strip()) for cell in cells_of(text, separator))
                decimal = "," if commas else "."
            last = len(text) - max(text.rfind(each) for each in ".,; \t")
            if not line.endswith(("\n", "\r")) and len(decimals) == 1 < len(rows) and last < min(decimals):
                notes.append(f"{path}: row {number + 1}, the last, ends within a number and is left out")
                skipped.append(number)
                continue
            decimals.add(last)
            rows.append(number)
    if "\0" in line:
        notes.append(f"{path}: ends in zero bytes, which are left out: the recording was broken off")
    names = tuple(name.strip() for name in header or ())
    return Layout(encoding, separator or ",", decimal, names, units, frozenset(skipped),
                  np.array(rows, dtype=int), most, tuple(notes))  # fmt: skip


def rows_in(path: Path, layout: Layout) -> Iterator[tuple[int, list[str]]]:
    """Number, from 1, and cells of each row, as text."""
    kept = set(layout.rows.tolist())
    with path.open(encoding=layout.encoding, newline="") as file:
        for number, line in enumerate(file):
            if number in kept:
                yield number + 1, cells_of(line.rstrip("\r\n"), layout.separator)


def header_of(line: str, comments: Sequence[str], separator: str) -> list[str] | None:
    """The header, if a comment holds it, as of `numpy.savetxt`, and `line` is the first row of numbers."""
    cells = cells_of(line, separator)
    if not _numeric(cells):
        return None
    for comment in reversed(comments):
        names = cells_of(comment.lstrip("#%/ \t"), separator)
        if len(names) == len(cells) and not _numeric(names):
            return names
    return None


def check_header(cells: Sequence[str], where: str) -> None:
    """InputError for a header of numbers alone, as where there is none."""
    if cells and _numeric(cells):
        expected = "a header row with a column t of times in s, but the first row holds numbers"
        raise InputError(f"{where}: column t", "missing", expected)


def separator_of(line: str) -> str:
    """The character that separates the cells of a header."""
    for separator in ("\t", ";", ","):
        if separator in line:
            return separator
    return SPACES if len(line.split()) > 1 else ","


def cells_of(line: str, separator: str) -> list[str]:
    """Cells of a line, without quotes."""
    if separator == SPACES:
        return line.split()
    if '"' in line:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return line.split(separator)


def _numeric(cells: Sequence[str]) -> bool:
    return all(NUMBER.fullmatch(cell.strip().replace(",", ".")) for cell in cells)


def units_of(header: list[str], cells: list[str]) -> dict[str, str]:
    """Units of a row with nothing else, such as `s;mm;N` or `[s],[mm],[N]`; empty for any other row."""
    if len(cells) != len(header):
        return {}
    found = {}
    for name, cell in zip(header, cells, strict=True):
        cell = cell.strip().strip("[]()").strip()
        unit = known_unit(cell) if cell and not NUMBER.fullmatch(cell) else None
        if cell not in ("", "-") and unit is None:
            return {}
        if unit is not None:
            found[name.strip()] = unit
    return found
