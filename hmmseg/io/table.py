"""Tables as files and data frames hold them, and numeric columns from them, before anything is mapped."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError

MAX_ROWS = 200_000_000  # numerics: more is a damaged or hostile file: 13 columns of it would be 20 GB
DATE = re.compile(r"\d{4}(?=.{4}).*-.*-")  # how a column of dates begins
MAX_COLUMNS = 20_000  # limit: no robot records so many; the arrays of each take kilobytes


@dataclass(frozen=True)
class Table:
    """Columns of one file or frame under their own names."""

    file: str  # name for messages
    names: tuple[str, ...]  # all columns of the file
    columns: dict[str, np.ndarray]  # those read, of lengths that may differ: more states than actions, say
    rows: np.ndarray  # (num_rows,) numbers as an editor counts them; as many as most columns have
    units: dict[str, str] = field(default_factory=dict)  # as stated by the file itself
    origin: int | None = None  # where t = 0 lies in ns since 1970 (logs)
    interpolated: dict[str, np.ndarray] = field(default_factory=dict)  # samples between two messages
    messages: bool = False  # whether it is a log of messages
    rates: dict[str, float] = field(default_factory=dict)  # [Hz] of the messages
    notes: tuple[str, ...] = ()  # what was left out of the file


def make_table(
    file: str, columns: dict[str, np.ndarray], names: Iterable[str] = (), wanted: Sequence[str] | None = None
) -> Table:
    """A table whose rows count from 1, as many as most columns have; `names`: all columns, read or not."""
    columns = flat(columns)
    every = (*columns, *(n for n in names if n not in columns and f"{n}[0]" not in columns))
    if wanted is not None:
        columns = {name: values for name, values in columns.items() if name in wanted}
    lengths = [len(values) for values in columns.values()]
    count = max(lengths, key=lengths.count, default=0)
    return Table(file, every, columns, np.arange(1, count + 1))


def is_wanted(name: str, wanted: Sequence[str] | None) -> bool:
    """Whether a column is to be read: `pose[2]` belongs to the column `pose`."""
    return wanted is None or name in wanted or any(each.startswith(f"{name}[") for each in wanted)


def check_part(path: Path, part: str | None, found: Sequence[str]) -> None:
    """InputError unless `part` names one of the recordings found, or there is only one."""
    if part is None and len(found) > 1:
        raise InputError(
            str(path), f"holds {len(found)} recordings", f"{path.name}#{found[0]} for one of them"
        )
    if part is not None and part not in found:
        raise InputError(f"{path}#{part}", "no such recording", ", ".join(found[:5]) or "no #")


def check_unique(names: Sequence[str], where: str) -> None:
    """InputError if two columns share a name."""
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{where}: column {name}", "appears twice", "one of each name")


def append(table: Table, more: Table) -> Table:
    """A table followed by the rows of another with the same columns."""
    columns = {name: np.concatenate([values, more.columns[name]]) for name, values in table.columns.items()}
    return replace(table, columns=columns, rows=np.concatenate([table.rows, more.rows]))


def flat(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of several numbers per row split into one column each: `pose[0]`, `pose[1]`, ..."""
    out: dict[str, np.ndarray] = {}
    for name, values in columns.items():
        values = np.atleast_1d(values)
        if values.ndim == 1:
            out[name] = values
        else:
            wide = values.reshape(len(values), -1)
            out |= {f"{name}[{i}]": wide[:, i] for i in range(wide.shape[1])}
    return out


def numbers(table: Table, name: str) -> np.ndarray:
    """A column as float64 (num_rows,), NaN where its cell is empty; InputError for what is no number."""
    column = table.columns[name]
    where = f"{table.file}: column {name}"
    if column.dtype.kind in "fiu":
        values = column.astype(np.float64)
        bad = np.flatnonzero(np.isinf(values))
    elif column.dtype.kind in "OUS":
        import pandas as pd

        texts = pd.Series(column)
        if any(isinstance(entry, bool | np.bool_) for entry in column[:1000]):
            raise InputError(where, "holds bool", "numbers")
        values = pd.Series(pd.to_numeric(texts, errors="coerce")).to_numpy(np.float64, na_value=np.nan)
        bad = np.flatnonzero((np.isnan(values) & texts.notna().to_numpy()) | np.isinf(values))
    else:
        raise InputError(where, f"holds {column.dtype}", "numbers")
    if bad.size:
        raise InputError(f"{table.file}: row {table.rows[bad[0]]}, column {name}",
                         f"{shown(column[bad[0]])} is not a finite number",
                         "a number or an empty cell")  # fmt: skip
    return values


def holds_text(values: np.ndarray) -> bool:
    """Whether a column has words and no numbers, such as a comment in every row."""
    if values.dtype.kind not in "OUS":
        return False
    import pandas as pd

    entries = pd.Series(values).dropna()
    words = entries.map(lambda entry: isinstance(entry, str))
    numeric = pd.Series(pd.to_numeric(entries, errors="coerce"))
    return bool(entries.size and words.all() and numeric.isna().all())


def times(table: Table, name: str) -> tuple[np.ndarray, int | None]:
    """A column of times (num_rows,) [s], of dates since the first, and the first in ns since 1970."""
    column = table.columns[name]
    if column.dtype.kind == "m":
        return column.astype("timedelta64[ns]").astype(np.float64) * 1e-9, None
    if column.dtype.kind == "M":
        stamps = column.astype("datetime64[ns]")
    elif column.dtype.kind in "OU" and any(DATE.match(str(entry)) for entry in column[:1000]):
        import pandas as pd

        texts = pd.Series(column)
        dates = pd.to_datetime(texts, errors="coerce", utc=True, format="ISO8601")
        bad = np.flatnonzero((dates.isna() & texts.notna()).to_numpy())
        if bad.size:
            raise InputError(f"{table.file}: row {table.rows[bad[0]]}, column {name}",
                             f"{shown(column[bad[0]])} is not a date", "ISO 8601 in every row")  # fmt: skip
        stamps = dates.dt.tz_localize(None).to_numpy().astype("datetime64[ns]")
    else:
        return numbers(table, name), table.origin
    present = np.flatnonzero(~np.isnat(stamps))
    if not present.size:
        raise InputError(f"{table.file}: column {name}", "has no values", "times")
    first = stamps[present[0]]
    seconds = (stamps - first).astype("timedelta64[ns]").astype(np.float64) * 1e-9
    return np.where(np.isnat(stamps), np.nan, seconds), int(first.astype(np.int64))


def shown(value: object) -> str:
    """A cell for a message: one short line."""
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else text[:60] + "..."


def frame_table(source: Any, wanted: Sequence[str] | None) -> Table:
    """Table of a data frame or dict, rows counted from 1; InputError for anything else."""
    where = "DataFrame" if hasattr(source, "columns") else type(source).__name__
    if hasattr(source, "items"):  # a dict or a pandas frame
        named = list(source.items())
    elif hasattr(source, "get_columns"):  # a polars frame
        named = list(zip(source.columns, source.get_columns(), strict=True))
    else:
        raise InputError(where, "is no table", "a file, a DataFrame or a dict of arrays")
    names = [str(name).strip() for name, _ in named]
    check_unique(names, where)
    kept = {name: _array(values) for name, (_, values) in zip(names, named, strict=True)
            if is_wanted(name, wanted)}  # fmt: skip
    return make_table(where, kept, names)


def _array(values: Any) -> np.ndarray:
    if hasattr(values, "dtype") and type(values.dtype).__module__.startswith("pandas"):  # nullable
        if values.dtype.kind in "fiu":
            return values.to_numpy(dtype=np.float64, na_value=np.nan)
        if values.dtype.kind == "M":  # with a time zone
            return values.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()
        return values.to_numpy(dtype=object)
    if hasattr(values, "to_numpy"):
        return values.to_numpy()
    return np.asarray(values)
