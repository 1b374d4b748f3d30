"""A log of a robot: times and columns, all of it or a window."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.hand.plausibility import check_clock
from hmmseg.io.formats import read_table
from hmmseg.io.formats.logs import interpolated
from hmmseg.io.rig import Rig
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import MIN_SAMPLES, trial_of
from hmmseg.io.units import Column

OTHER = "not the time"  # look: our name of a column t where another counts the time


@dataclass(frozen=True)
class Recording:
    """A log, or a window of one; NaN is a missing sample, and `recording["q1"]` a column."""

    name: str
    t: np.ndarray  # (num_timesteps,) [s]
    columns: Mapping[str, np.ndarray]  # by name
    first: int = 0  # row of the whole log
    warnings: tuple[str, ...] = ()  # what was left out of its file

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def __len__(self) -> int:
        return self.t.size

    def window(self, begin: int, end: int) -> Recording:
        """The rows [begin, end)."""
        columns = {name: values[begin:end] for name, values in self.columns.items()}
        return Recording(self.name, self.t[begin:end], columns, self.first + begin)

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> Recording:
        """The recording with some columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})


def read_recording(
    path: Path, wanted: Iterable[str], times: str = "t", unit: float = 1.0, commands: Collection[str] = (),
    acts: str | None = None,
) -> Recording:  # fmt: skip
    """Read the columns that a simulator needs from a file of any kind.

    Columns that come at rates of their own, in rows of their own, are brought to the rows of the fastest.

    Args:
        path: The file.
        wanted: Names of its columns.
        times: The column of times.
        unit: Its unit [s].
        commands: Columns that are held from sample to sample.
        acts: Name of a column to add where rows differ in when their commands were given: these times [s].

    Returns:
        The recording.

    Raises:
        InputError: A column is missing, a cell is no number, or the clock goes back or has another unit.
    """
    names = tuple(dict.fromkeys(wanted))
    ours = {n: OTHER if n == "t" != times else n for n in names}
    given = {"t": Column.model_validate({"from": times, "unit": unit})}
    given |= {OTHER: Column.model_validate({"from": "t"})} if OTHER in ours.values() else {}
    rig = Rig.model_construct(columns=given, topics=given if times != "t" else {})
    table = read_table(path, [times, *names])
    if times not in table.names:
        expected = f'times in s, or time = "..." in map.toml, {nearest(times, table.names)}'
        raise InputError(f"{path}: column {times}", "missing", expected)
    for name in names:
        if name not in table.names:
            raise InputError(f"{path}: column {name}", "missing", nearest(name, table.names))
    trial = trial_of(table, rig, SequenceTask(("all",), channels=tuple(ours.values())))
    for finding in check_clock(trial, None):
        if finding.certain:
            remedy = f'{{column = "{times}", unit = {json.dumps(finding.changes["t"]["unit"])}}}'
            raise InputError(f"{path}: column {times}", finding.problem, f"time = {remedy} in map.toml")
    columns = {n: trial.channels[own] for n, own in ours.items() if own in trial.channels}
    found = Recording(path.name, trial.t, columns, warnings=trial.warnings)
    return _on_one_clock(found, commands, acts)


def _on_one_clock(log: Recording, commands: Collection[str], acts: str | None) -> Recording:
    """The rows of the column that is read most often.

    Slower columns are interpolated like topics of a log, at the rows nearest to their own samples: more would
    count noise twice. Commands count with their mean until the next row; or, where all are given together and
    at most once a row, as they are, from when they were given."""
    rows = {name: np.flatnonzero(np.isfinite(values)) for name, values in log.columns.items()}
    if all(np.median(np.diff(each)) <= 1 for each in rows.values() if each.size > 1):
        return log
    kept = max((each for name, each in rows.items() if name not in commands), key=len, default=None)
    if kept is None or kept.size < MIN_SAMPLES:
        return log
    t = log.t[kept]
    columns = {}
    given = [rows[name] for name in log.columns if name in commands]
    if acts is not None and given and all(np.array_equal(each, given[0]) for each in given):
        latest = np.searchsorted(given[0], kept, side="right") - 1
        if np.diff(latest).max(initial=0) <= 1:
            columns[acts] = np.where(latest >= 0, log.t[given[0][np.maximum(latest, 0)]], t)
    for name, values in log.columns.items():
        seen = rows[name]
        if name not in commands:
            read = np.isin(np.arange(t.size), np.searchsorted(0.5 * (t[1:] + t[:-1]), log.t[seen]))
            columns[name] = np.where(read, interpolated(t, log.t[seen], values[seen])[0], np.nan)
            continue
        if acts in columns:
            columns[name] = values[seen[np.maximum(latest, 0)]]
            continue
        until = np.append(t, 2 * t[-1] - t[-2])
        steady = held(values)
        area = np.concatenate([[0.0], np.cumsum(steady[:-1] * np.diff(log.t))])
        last = np.clip(np.searchsorted(log.t, until, side="right") - 1, 0, log.t.size - 1)
        done = area[last] + steady[last] * (until - log.t[last])
        columns[name] = np.diff(done) / np.diff(until)
    return Recording(log.name, t, columns, log.first, log.warnings)


def held(values: np.ndarray) -> np.ndarray:
    """A column (num_timesteps,) whose missing samples repeat the one before; leading ones the next."""
    there = np.flatnonzero(np.isfinite(values))
    if not there.size:
        return values
    return values[there[np.maximum(np.searchsorted(there, np.arange(values.size), side="right") - 1, 0)]]
