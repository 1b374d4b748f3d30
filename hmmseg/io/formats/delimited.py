"""Tables in text as labs write them.

Separators are commas, semicolons, tabs or runs of spaces; decimals have points, or commas where
cells are not separated by them; lines that begin with #, % or // are comments, and a comment
may be the header (as `numpy.savetxt` writes it); a row of units may follow the header.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.table import Table
from hmmseg.io.units import known_unit

COMMENTS = ("#", "%", "//")
SPACES = r"\s+"
TEXT = frozenset(range(256)) - set(range(9)) - set(range(14, 32)) - {127}  # bytes that a text may have
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|NaN|inf|")
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclass(frozen=True)
class Layout:
    """How one text file is laid out; line numbers count from 0."""

    encoding: str
    separator: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    skipped: frozenset[int]
    rows: np.ndarray


def read(path: Path, part: str | None, wanted: Sequence[str] | None) -> Table:
    """Table of a text file; its rows are numbered by line, from 1."""
    import pandas as pd

    layout = find_layout(path)
    names = [name for name in layout.names if name]
    if len(names) != len(set(names)):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: column {twice}", "appears twice", "one of each name")
    chosen = [i for i, name in enumerate(layout.names) if name and (wanted is None or name in wanted)]
    frame = pd.read_csv(
        path, sep=layout.separator, decimal=layout.decimal, encoding=layout.encoding, header=None,
        names=list(range(len(layout.names))), usecols=chosen, index_col=False, skipinitialspace=True,
        skiprows=layout.skipped.__contains__, skip_blank_lines=False, low_memory=False,
    ) if chosen else pd.DataFrame(index=range(layout.rows.size))  # fmt: skip
    if len(frame) != layout.rows.size:
        raise InputError(str(path), f"{layout.rows.size} lines make {len(frame)} rows", "one line a row")
    kept = ~frame.isna().to_numpy().all(axis=1) if chosen else np.ones(len(frame), dtype=bool)
    columns = {layout.names[i]: _plain(frame[i])[kept] for i in chosen}
    rows = layout.rows[kept] + 1
    if layout.decimal == ",":
        _no_points(columns, rows, str(path))
    return Table(str(path), tuple(names), columns, rows, layout.units)


def _plain(column) -> np.ndarray:
    values = column.to_numpy()
    return values if isinstance(values, np.ndarray) else np.asarray(values, dtype=object)


def _no_points(columns: dict[str, np.ndarray], rows: np.ndarray, where: str) -> None:
    """InputError for 1.5 or 1.234,5 among decimal commas: nobody can say what it means."""
    for name, values in columns.items():
        if values.dtype.kind != "O":
            continue
        for i, cell in enumerate(values):
            if isinstance(cell, str) and "." in cell and NUMBER.fullmatch(cell.replace(",", "").strip()):
                raise InputError(f"{where}: row {rows[i]}, column {name}",
                                 f"{cell} has a decimal point, others have commas", "one kind")  # fmt: skip


def find_layout(path: Path) -> Layout:
    """Layout of a text file, every row checked for its number of cells."""
    encoding = _encoding(path)
    try:
        return _layout(path, encoding)
    except UnicodeDecodeError as error:
        start = error.object[: error.start + 1]
        if encoding != "utf-8-sig" or not set(start) < TEXT:
            raise
        return _layout(path, "cp1252")  # umlauts as spreadsheets of western Europe write them


def _layout(path: Path, encoding: str) -> Layout:
    separator, header, comment = "", None, ""
    units: dict[str, str] = {}
    skipped: list[int] = []
    rows: list[int] = []
    decimal = "."
    with path.open(encoding=encoding, newline="") as file:
        for number, line in enumerate(file):
            line = line.rstrip("\r\n")
            if not line.strip() or line.lstrip().startswith(COMMENTS):
                skipped.append(number)
                comment = line if line.strip() and header is None else comment
                continue
            if header is None:
                separator = _separator(line)
                header = _cells(line, separator)
                said = _cells(comment.lstrip().lstrip("#%/").strip(), separator)
                if len(said) == len(header) and _numeric(header) and not _numeric(said):
                    header = said  # a header in a comment; this line is the first row
                else:
                    skipped.append(number)
                    continue
            if line.count('"') % 2:
                raise InputError(f"{path}: row {number + 1}", "a quoted cell does not end", "one line a row")
            quick = '"' not in line and separator != SPACES
            found = line.count(separator) + 1 if quick else len(_cells(line, separator))
            if found != len(header):
                if line.replace(separator, "").strip():
                    raise InputError(f"{path}: row {number + 1}", f"has {found} cells",
                                     f"{len(header)} as in the header")  # fmt: skip
                skipped.append(number)
                continue
            if not rows and not units and units_of(header, _cells(line, separator)):
                units = units_of(header, _cells(line, separator))
                skipped.append(number)
                continue
            if decimal == "." and separator != "," and "," in line and _comma_numbers(line, separator):
                decimal = ","
            rows.append(number)
    names = tuple(name.strip() for name in header or ())
    return Layout(
        encoding, separator or ",", decimal, names, units, frozenset(skipped), np.array(rows, dtype=int)
    )


def _encoding(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(4)
    return "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def _separator(line: str) -> str:
    for separator in ("\t", ";", ","):
        if separator in line:
            return separator
    return SPACES if len(line.split()) > 1 else ","


def _cells(line: str, separator: str) -> list[str]:
    if separator == SPACES:
        return line.split()
    if '"' in line:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return line.split(separator)


def _numeric(cells: list[str]) -> bool:
    return all(NUMBER.fullmatch(cell.strip().replace(",", ".")) for cell in cells)


def _comma_numbers(line: str, separator: str) -> bool:
    return any(COMMA_NUMBER.fullmatch(cell.strip()) for cell in _cells(line, separator))


def units_of(header: list[str], cells: list[str]) -> dict[str, str]:
    """Units of a row that holds nothing else: `s;mm;N`, `[s],[mm],[N]`; empty where it is no such row."""
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
