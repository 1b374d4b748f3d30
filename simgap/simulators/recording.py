"""A log of a robot: times and columns, whole or a window of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import read_trial


@dataclass(frozen=True)
class Recording:
    """Times `t` (num_timesteps,) [s] and `columns` by name, of the rows `first` and up of a whole log.

    NaN is a missing sample. `recording["q1"]` is a column.
    """

    name: str
    t: np.ndarray
    columns: Mapping[str, np.ndarray]
    first: int = 0

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def __len__(self) -> int:
        return self.t.size

    def window(self, begin: int, end: int) -> Recording:
        """The rows [begin, end)."""
        columns = {name: values[begin:end] for name, values in self.columns.items()}
        return Recording(self.name, self.t[begin:end], columns, self.first + begin)

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> Recording:
        """The recording with some columns replaced."""
        return replace(self, columns={**self.columns, **columns})


def read_recording(path: Path, wanted: Iterable[str], times: str = "t") -> Recording:
    """Recording from a .csv, .parquet or .npz file with the columns that a simulator needs.

    `times` is the name of the time column. InputError names the file and the row or column at fault: a
    column that is missing, a cell that is no number, a clock that goes back.
    """
    names = tuple(dict.fromkeys(wanted))
    if times != "t":
        return _renamed(path, names, times)
    trial = read_trial(path, task=SequenceTask(("all",), channels=names))
    return Recording(path.name, trial.t, trial.channels)


def _renamed(path: Path, names: tuple[str, ...], times: str) -> Recording:
    import pandas as pd

    readers = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
    if path.suffix.lower() not in readers:
        raise InputError(str(path), f"its times are in column {times!r}", "a .csv or .parquet file")
    frame = readers[path.suffix.lower()](path)
    if times not in frame.columns:
        raise InputError(f"{path}: column {times}", "missing", "the column of times in s")
    frame = frame.drop(columns=[c for c in ("t",) if c in frame.columns]).rename(columns={times: "t"})
    try:
        trial = read_trial(frame, task=SequenceTask(("all",), channels=names))
    except InputError as error:
        where = error.where.replace("DataFrame", str(path)).replace("column t", f"column {times}")
        raise InputError(where, error.problem, error.expected) from None
    return Recording(path.name, trial.t, trial.channels)
