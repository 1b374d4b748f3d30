"""Trials: one recording each, read from CSV, Parquet, NPZ or a pandas DataFrame."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from hmmseg.io.task import SequenceTask

JOINT_CHANNELS = ("q11", "q12", "dq11", "dq12", "fx1", "fy1", "q21", "q22", "dq21", "dq22", "fx2", "fy2")
CARTESIAN_CHANNELS = ("x1", "y1", "vx1", "vy1", "fx1", "fy1", "x2", "y2", "vx2", "vy2", "fx2", "fy2")
CARTESIAN_OPTIONAL = ("vx1", "vy1", "vx2", "vy2")
MIN_SAMPLES = 8
UNNAMED = "\0"


@dataclass(frozen=True)
class Trial:
    """One recording: times `t` (num_timesteps,) [s] and channels by name, NaN where missing."""

    file: str
    t: np.ndarray
    channels: dict[str, np.ndarray]

    @property
    def rate(self) -> float:
        """Median sampling rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    @property
    def name(self) -> str:
        """The file's name without its folder."""
        return Path(self.file).name


def read_trial(source: str | Path | pd.DataFrame, rig: Rig | None = None,
               task: SequenceTask | None = None) -> Trial:  # fmt: skip
    """Trial from a file or DataFrame, checked; InputError names file, row or column.

    The channels kept are the rig's (joint space or Cartesian), or for a plain ordered task the
    ones it names (every column but `t` otherwise).
    """
    if isinstance(source, pd.DataFrame):
        where, frame = "DataFrame", source.set_axis(range(1, len(source) + 1))
    else:
        where, frame = str(source), _read_frame(Path(source))
    frame = frame.rename(columns=lambda name: str(name).strip())
    _check_header(list(frame.columns), where)
    wanted, optional = _wanted(frame, rig, task, where)
    for name in wanted:
        if name not in frame.columns and name not in optional:
            raise InputError(f"{where}: column {name}", "missing", ", ".join(("t", *wanted)))
    t = _column(frame, "t", where)
    _check_times(t, frame.index, where)
    channels = {name: _column(frame, name, where) for name in wanted if name in frame.columns}
    empty = [name for name, values in channels.items() if not np.isfinite(values).any()]
    for name in empty:
        if name not in optional:
            raise InputError(f"{where}: column {name}", "has no values", "at least one number")
        del channels[name]  # as good as absent
    return Trial(where, t, channels)


def _wanted(frame: pd.DataFrame, rig: Rig | None, task: SequenceTask | None,
            where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:  # fmt: skip
    if task is not None:
        names = task.channels or tuple(str(c) for c in frame.columns if c != "t")
        if not names:
            raise InputError(where, "has no columns but t", "at least one channel")
        for name in names:
            if name not in frame.columns:
                raise InputError(f"{where}: column {name}", "missing",
                                 nearest(name, [str(c) for c in frame.columns]))  # fmt: skip
        return names, ()
    if rig is None:
        raise ValueError("a block task's trial needs its rig")
    return (JOINT_CHANNELS, ()) if rig.jointed else (CARTESIAN_CHANNELS, CARTESIAN_OPTIONAL)


def _read_frame(path: Path) -> pd.DataFrame:
    """Table of a file; its index is the row as an editor numbers it (CSV) or counts from 1."""
    readers = {".csv": _read_csv, ".parquet": _read_parquet, ".npz": _read_npz}
    if not path.exists():
        raise InputError(str(path), "no such file", "a trial (.csv, .parquet or .npz)")
    if path.suffix.lower() not in readers:
        raise InputError(str(path), f"unknown kind of file {path.suffix!r}", ", ".join(readers))
    try:
        return readers[path.suffix.lower()](path)
    except InputError:
        raise
    except ImportError:
        raise InputError(str(path), "Parquet support is not installed",
                         "pip install 'hmmseg[parquet]'") from None  # fmt: skip
    except Exception as error:  # whatever a parser makes of a file it cannot parse
        raise InputError(str(path), f"cannot be read ({error})", "a table with a header row") from error


def _read_csv(path: Path) -> pd.DataFrame:
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = csv.reader(file)
        header = [name.strip() or f"{UNNAMED}{i}" for i, name in enumerate(next(lines, []))]
        _check_header(header, str(path))
        for cells in lines:
            if any(cells) and len(cells) != len(header):  # pandas would shift or drop columns silently
                raise InputError(f"{path}: row {lines.line_num}", f"has {len(cells)} cells",
                                 f"{len(header)} as in the header")  # fmt: skip
        file.seek(0)
        frame = pd.read_csv(file, header=0, names=header, index_col=False, skipinitialspace=True,
                            skip_blank_lines=False, low_memory=False)  # fmt: skip
    unnamed = [name for name in header if name.startswith(UNNAMED)]  # a row index, trailing commas
    return frame.set_axis(range(2, len(frame) + 2)).drop(columns=unnamed).dropna(how="all")


def _read_parquet(path: Path) -> pd.DataFrame:
    frame = pd.read_parquet(path)
    return frame.set_axis(range(1, len(frame) + 1))


def _read_npz(path: Path) -> pd.DataFrame:
    with path.open("rb") as file:
        arrays = np.load(file)
        if isinstance(arrays, np.ndarray):
            raise InputError(str(path), "holds one array without a name", "one array a column")
        frame = pd.DataFrame({name: np.atleast_1d(arrays[name]) for name in arrays.files})
    return frame.set_axis(range(1, len(frame) + 1))


def _check_header(names: list[str], where: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{where}: column {name}", "appears twice", "one of each name")
    if "t" not in names:
        raise InputError(f"{where}: column t", "missing", "a header row with a column t of times in s")


def _column(frame: pd.DataFrame, name: str, where: str) -> np.ndarray:
    column = frame[name]
    if column.dtype.kind not in "fiuO" and not pd.api.types.is_string_dtype(column):
        raise InputError(f"{where}: column {name}", f"holds {column.dtype}", "numbers")
    numbers = pd.Series(pd.to_numeric(column, errors="coerce"))
    values = numbers.to_numpy(dtype=np.float64, na_value=np.nan)
    bad = np.flatnonzero((np.isnan(values) & column.notna().to_numpy()) | np.isinf(values))
    if bad.size:
        raise InputError(f"{where}: row {frame.index[bad[0]]}, column {name}",
                         f"{column.iloc[bad[0]]} is not a finite number",
                         "a number or an empty cell")  # fmt: skip
    return values


def _check_times(t: np.ndarray, rows: pd.Index, where: str) -> None:
    if t.size < MIN_SAMPLES:
        raise InputError(where, f"has {t.size} samples", f"at least {MIN_SAMPLES}")
    missing = np.flatnonzero(~np.isfinite(t))
    if missing.size:
        raise InputError(f"{where}: row {rows[missing[0]]}, column t", "missing", "a time in s")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        i = back[0] + 1
        raise InputError(f"{where}: row {rows[i]}, column t", f"{t[i]:g} after {t[i - 1]:g}",
                         "strictly increasing times")  # fmt: skip
