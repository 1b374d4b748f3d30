"""What is in a recording's file: channels with their units, rates, gaps and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.columns import Column
from hmmseg.io.formats import parts_of, read_table
from hmmseg.io.propose import as_toml, mended, propose
from hmmseg.io.propose_gripper import propose_gripper
from hmmseg.io.rig import Rig
from hmmseg.io.table import Table, numbers
from hmmseg.io.trial import CARTESIAN_CHANNELS, CARTESIAN_OPTIONAL, JOINT_CHANNELS, mapped_times, trial_of
from hmmseg.io.units import unit_in_name
from hmmseg.levels import GAP

BUCKETS = 24  # numerics: of a small plot


@dataclass(frozen=True)
class Channel:
    """One column: its unit where the file or its name tells, its rate [Hz] where times are known,
    how many samples lack it or were interpolated, its range, and its course in few means.
    """

    name: str
    unit: str | None
    rate: float | None
    samples: int
    missing: int
    interpolated: int
    minimum: float | None
    maximum: float | None
    course: tuple[float, ...]
    text: bool = False


@dataclass(frozen=True)
class Inspection:
    """One file: its recordings, its clock, gaps [(start, end) in s], channels and proposed mapping.

    `understood`: all that a hand needs (this rig's, or one of two fingers) is there under our names.
    """

    file: str
    parts: tuple[str, ...]
    samples: int
    start: float | None
    end: float | None
    rate: float | None
    origin: int | None
    gaps: tuple[tuple[float, float], ...]
    channels: tuple[Channel, ...]
    mapping: dict[str, dict[str, Any]]
    toml: str
    said: tuple[str, ...]
    understood: bool


def inspect(path: str | Path, rig: Rig | None = None) -> Inspection:
    """What a file holds (of several recordings the first), judged with the rig where it is given."""
    parts = parts_of(path)
    table = read_table(f"{path}#{parts[0]}" if parts else path)
    if not table.names or not table.rows.size:
        raise InputError(str(path), "is empty", "a header row and a row for every sample")
    already = {} if rig is None else (rig.topics if table.messages else rig.columns)
    entries = {} if already else propose(table)
    entries, said = mended(table, entries, rig)
    said = [*table.notes, *(f"{path}: {line}" for line in (*_lengths(table), *said))]
    toml = as_toml(entries, table) if entries else ""
    if set(entries) <= {"t"} and not already and (rig is None or rig.gripper is None):
        toml = propose_gripper(table, entries) or toml
    t, origin = _clock(table, entries, rig)
    channels = tuple(_channel(table, name, t) for name in table.names if name in table.columns)
    gaps: list[tuple[float, float]] = []
    rate = None
    if t is not None and t.size > 2:
        steps = np.diff(t)
        rate = float(1 / np.median(steps)) if np.median(steps) > 0 else None
        wide = np.flatnonzero(steps > GAP * np.median(steps))
        gaps = [(float(t[i]), float(t[i + 1])) for i in wide]
    return Inspection(
        str(path), tuple(parts), int(table.rows.size), None if t is None or not t.size else float(t[0]),
        None if t is None or not t.size else float(t[-1]), rate, origin, tuple(gaps), channels, entries,
        toml, tuple(said), not toml and _understood(table, rig),
    )  # fmt: skip


def _understood(table: Table, rig: Rig | None) -> bool:
    hands = (set(CARTESIAN_CHANNELS) - set(CARTESIAN_OPTIONAL), set(JOINT_CHANNELS))
    if rig is None:
        return any(wanted <= set(table.names) for wanted in hands)
    try:
        return bool(trial_of(table, rig, None).channels)
    except InputError:
        return False


def _lengths(table: Table) -> list[str]:
    """What is said of columns of another length than most."""
    by_length: dict[int, list[str]] = {}
    for name, values in table.columns.items():
        by_length.setdefault(len(values), []).append(name)
    others = f"not {table.rows.size} as the others: they are not read together"
    return [f"columns {', '.join(names)} have {length} rows, {others}"
            for length, names in by_length.items() if length != table.rows.size]  # fmt: skip


def _clock(table: Table, entries: dict[str, dict[str, Any]], rig: Rig | None
           ) -> tuple[np.ndarray | None, int | None]:  # fmt: skip
    """Times [s] as the proposal or the rig has them; None where the file has none that can be used."""
    rig = rig or Rig()
    if "t" in entries:
        rig = rig.model_copy(update={"columns": {**rig.columns, "t": Column.model_validate(entries["t"])}})
    try:
        return mapped_times(table, rig)
    except InputError:
        return None, None


def _channel(table: Table, name: str, t: np.ndarray | None) -> Channel:
    unit = "s" if table.messages and name == "t" else table.units.get(name) or unit_in_name(name)
    between = int(table.interpolated[name].sum()) if name in table.interpolated else 0
    try:
        values = numbers(table, name)
    except InputError:
        return Channel(name, unit, None, len(table.columns[name]), 0, 0, None, None, (), text=True)
    there = values[np.isfinite(values)]
    rate = table.rates.get(name)
    if rate is None and t is not None and t.size > 2 and t[-1] > t[0]:
        rate = float((there.size - 1) / (t[-1] - t[0]))
    low, high = (float(there.min()), float(there.max())) if there.size else (None, None)
    return Channel(
        name, unit, rate, values.size, values.size - there.size, between, low, high, _course(values)
    )


def _course(values: np.ndarray) -> tuple[float, ...]:
    """Means of equal stretches, NaN where nothing is."""
    with np.errstate(invalid="ignore"):
        pieces = np.array_split(values, min(BUCKETS, max(values.size, 1)))
        return tuple(float(np.mean(p[np.isfinite(p)])) if np.isfinite(p).any() else np.nan for p in pieces)
