"""Trials: one recording each, from a file of any kind, a data frame or arrays, mapped to our channels."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from hmmseg.io.table import Table, check_unique, holds_text, numbers, times
from hmmseg.io.task import SequenceTask, Task
from hmmseg.io.units import LARGEST, LATEST, Column, measures, si_factor, source_of, unwrapped
from hmmseg.tables import Tabled, listed

JOINT_CHANNELS = ("q11", "q12", "dq11", "dq12", "fx1", "fy1", "q21", "q22", "dq21", "dq22", "fx2", "fy2")
CARTESIAN_CHANNELS = ("x1", "y1", "vx1", "vy1", "fx1", "fy1", "x2", "y2", "vx2", "vy2", "fx2", "fy2")
CARTESIAN_OPTIONAL = ("vx1", "vy1", "vx2", "vy2")
ROLL = "hand_roll"  # of a Cartesian hand whose fingers turn together [rad]; optional
MIN_SAMPLES = 8  # limit: fewer show no task
MAPPED = "or [columns] in rig.toml (hmmseg inspect proposes it)"


@dataclass(frozen=True, repr=False)
class Trial(Tabled):
    """One recording: times and channels by name, NaN where missing.

    Attributes:
        file: path or name of the source.
        t: (num_timesteps,) [s].
        channels: (num_timesteps,) each, in SI units.
        origin: where t = 0 lies in ns since 1970, if the file says.
        interpolated: for channels of a log, samples between two messages.
        warnings: what is unlikely about the recording.
        notes: what was found out while reading it.
        hidden: properties that this hand cannot reveal, with the reason.
        touch_sd: systematic uncertainty of the distance at which the fingers touch a block [m].
        step: steps in which places across (or the opening) and up are recorded, if coarser than their noise,
            else 0 [m].
        touches: times of touch and release known apart from forces, with their standard deviations [s].
        timing: (num_timesteps,) uncertainty of the time at which a force changes [s].
        inertia: (num_timesteps, 2), only of a wrist sensor, whose forces are halved between the fingers:
            standard error of the tool's own share, across and up [N].
        free: (num_timesteps,), only of a wrist sensor: 1 where the opening shows that nothing is held, else
            0.
        faults: of sensors (`hmmseg.hand.sensing`).
    """

    file: str
    t: np.ndarray
    channels: dict[str, np.ndarray]
    origin: int | None = None
    interpolated: dict[str, np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    hidden: dict[str, str] = field(default_factory=dict)
    touch_sd: float = 0.0
    step: tuple[float, ...] = (0.0, 0.0)
    touches: tuple[tuple[float, float], ...] = ()
    timing: np.ndarray | None = None
    inertia: np.ndarray | None = None
    free: np.ndarray | None = None
    faults: tuple[Any, ...] = ()

    @staticmethod
    def read(source: Any, rig: Any = None, task: Any = None) -> Trial:
        """Read one recording.

        Args:
            source: a file of any kind, a DataFrame (pandas, polars), a dict of arrays (num_timesteps,), or a
                trial, which is returned as it is.
            rig: the hand, which defines the channels and their mapping to columns: a `rig.toml`, its table
                as a dict, or a `Rig`.
            task: the description of a plain ordered task, instead of or with `rig`.

        Returns:
            The trial in SI units: times (num_timesteps,) [s] and channels by name, NaN where missing.

        Raises:
            InputError: names the file, row or column at fault and what was expected; also if the recording
                contradicts its description (other units, flipped signs, swapped fingers).
        """
        if isinstance(source, Trial):
            return source
        hand = None if rig is None else Rig.read(rig)
        order = None if task is None else Task.read(task)
        from hmmseg.hand.read import read_trial  # the only import upwards: hands judge their recordings

        return read_trial(source, hand, order if isinstance(order, SequenceTask) else None)

    def tables(self) -> list[Any]:
        """Its channels, with the number of missing samples and the range of each."""
        size, rows = f"{self.t.size} samples at {self.rate:.4g} Hz", []
        for name, values in self.channels.items():
            there = values[np.isfinite(values)]
            ends = (f"{there.min():.4g}", f"{there.max():.4g}") if there.size else ("", "")
            rows.append((name, str(values.size - there.size or ""), *ends))
        title = f"{self.name}: {size}, {self.t[0]:.4g} to {self.t[-1]:.4g} s"
        return [listed(title, ("channel", "missing", "least", "most"), rows, wraps=True)]

    @property
    def rate(self) -> float:
        """Median sampling rate [Hz]."""
        return float(1.0 / np.median(np.diff(self.t)))

    @property
    def name(self) -> str:
        """The file's name without its folder."""
        return Path(self.file).name

    @property
    def stem(self) -> str:
        """The name without its ending; `demos_demo_3` of `demos.hdf5#demo_3`."""
        name, _, part = self.name.partition("#")
        return Path(name).stem + f"_{part}" * bool(part)


def trial_of(table: Table, rig: Rig | None, task: SequenceTask | None, whole: bool = True) -> Trial:
    """Trial from a table, before checks of the hand; InputError for bad columns, empty ones if `whole`."""
    names, optional = channels_of(rig, task)
    columns: Mapping[str, Column] = {} if rig is None else (rig.topics if table.messages else rig.columns)
    for name, values in table.columns.items():
        if len(values) != table.rows.size:
            raise InputError(f"{table.file}: column {name}", f"has {len(values)} rows",
                             f"{table.rows.size} as in the others")  # fmt: skip
    _check_names(table, columns, names, optional, task is not None)
    fingers = task is None and rig is not None and rig.gripper is None
    third = ", ".join(name for name in table.names if fingers and _finger(name) > 2)
    more = (f"columns {third} are left out: hands have two fingers here, and what a third bears is missing "
            "from weights",) if third else ()  # fmt: skip
    t, origin = mapped_times(table, rig)
    channels: dict[str, np.ndarray] = {}
    if names is None:  # all channels of a plain task, by our names where they are mapped
        mapped = {source_of(name, columns): name for name in columns}
        ours = {name: mapped.get(name, name) for name in table.names if mapped.get(name, name) != "t"}
        text = [name for name in ours if name not in mapped and holds_text(table.columns[name])]
        more = tuple(f"{table.file}: column {name} holds text, and is left out" for name in text)
        names = tuple(own for name, own in ours.items() if name not in text)
    for name in names:
        theirs = source_of(name, columns)
        if theirs not in table.columns:
            continue
        values = _to_si(numbers(table, theirs), name, columns, table)
        beyond = np.flatnonzero(np.abs(np.nan_to_num(values)) > LARGEST)
        if task is None and beyond.size:
            raise InputError(f"{table.file}: row {table.rows[beyond[0]]}, column {theirs}",
                             f"{values[beyond[0]]:.3g} is no reading of a hand's sensor",
                             f"at most {LARGEST:.0g} in SI units")  # fmt: skip
        if not whole or np.isfinite(values).any():
            channels[name] = unwrapped(values) if measures(name) == "angle" and task is None else values
        elif name not in optional:  # an optional channel without values counts as absent
            raise InputError(f"{table.file}: column {theirs}", "has no values", "at least one number")
    between = {
        name: table.interpolated[source_of(name, columns)]
        for name in channels if source_of(name, columns) in table.interpolated
    }  # fmt: skip
    return Trial(table.file, t, channels, origin, between, warnings=(*table.notes, *more))


def mapped_times(table: Table, rig: Rig | None) -> tuple[np.ndarray, int | None]:
    """Times (num_rows,) [s], and where their zero lies in ns since 1970; InputError for invalid times."""
    columns: Mapping[str, Column] = {} if rig is None else (rig.topics if table.messages else rig.columns)
    name = source_of("t", columns)
    if name not in table.columns:
        raise InputError(f"{table.file}: column {name}", "missing", f"a column of times in s, {MAPPED}")
    stamps, origin = times(table, name)
    t = _to_si(stamps, "t", columns, table)
    _check_times(t, table)
    return t, origin


def channels_of(rig: Rig | None, task: SequenceTask | None) -> tuple[tuple[str, ...] | None, tuple[str, ...]]:
    """Channels of the hand or the task (None: all columns), and which of them are optional."""
    if task is not None:
        return task.channels, ()
    assert rig is not None
    if rig.gripper is not None:
        return rig.gripper.channels, ()
    if rig.jointed:
        return JOINT_CHANNELS, ()
    return (*CARTESIAN_CHANNELS, ROLL), (*CARTESIAN_OPTIONAL, ROLL)


def _finger(name: str) -> int:
    """Number of the finger whose channel has this name, 0 of any other."""
    found = re.fullmatch(r"[vf]?[xy](\d)|d?q(\d)[12]", name)
    return 0 if found is None else int(found.group(1) or found.group(2))


def _check_names(table: Table, columns: Mapping[str, Column], names: tuple[str, ...] | None,
                 optional: tuple[str, ...], plain: bool) -> None:  # fmt: skip
    where = table.file
    check_unique(table.names, where)
    tables = "[topics]" if table.messages else "[columns]"
    for ours in columns:
        if names is not None and ours not in ("t", *names):
            raise InputError(f"{where}: {tables} {ours}", "is no channel of this hand or task",
                             nearest(ours, ("t", *names)))  # fmt: skip
    for ours in ("t", *(names or ())):
        theirs = source_of(ours, columns)
        if theirs in table.names or (ours in optional and ours not in columns):
            continue
        if theirs != ours:
            raise InputError(f"{where}: column {theirs}", f"missing, but the rig maps {ours} to it",
                             nearest(theirs, table.names))  # fmt: skip
        if ours == "t":
            raise InputError(f"{where}: column t", "missing",
                             f"a header row with a column t of times in s, {MAPPED}")  # fmt: skip
        if not plain and _finger(ours) == 2 and not any(_finger(name) == 2 for name in table.names):
            raise InputError(f"{where}: column {theirs}", "missing, as all of finger 2",
                             f"two fingers, or a gripper with a wrist sensor ([gripper]), {MAPPED}"
                             )  # fmt: skip
        expected = nearest(theirs, table.names) if plain else f"{', '.join(('t', *(names or ())))}, {MAPPED}"
        raise InputError(f"{where}: column {theirs}", "missing", expected)
    if names is None and len(table.names) < 2:
        raise InputError(where, "has no columns but t", "at least one channel")


def _to_si(values: np.ndarray, ours: str, columns: Mapping[str, Column], table: Table) -> np.ndarray:
    """Values in SI, by the unit of the mapping or else the one that the file states."""
    entry = columns.get(ours, Column())
    unit = entry.unit if entry.unit is not None else table.units.get(source_of(ours, columns), 1.0)
    if unit == 1.0 and entry.sign == 1 and entry.offset == 0:
        return values
    return entry.sign * si_factor(unit) * values + entry.offset


def _check_times(t: np.ndarray, table: Table) -> None:
    where, rows = table.file, table.rows
    if t.size < MIN_SAMPLES:
        raise InputError(where, f"has {t.size} samples", f"at least {MIN_SAMPLES}")
    for bad, problem in ((~np.isfinite(t), "missing"), (np.abs(t) > LATEST, "{:.3g} is no time")):
        if bad.any():
            i = int(bad.argmax())
            raise InputError(f"{where}: row {rows[i]}, column t", problem.format(t[i]), "a time in s")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        i = back[0] + 1
        raise InputError(f"{where}: row {rows[i]}, column t", f"{t[i]:.13g} after {t[i - 1]:.13g}",
                         "strictly increasing times")  # fmt: skip


def position_pairs(trial: Trial) -> list[tuple[str, str]]:
    """Names of each position and its velocity, where both are recorded."""
    named = [(f"q{i}{j}", f"dq{i}{j}") for i in "12" for j in "12"]
    named += [(f"{axis}{i}", f"v{axis}{i}") for i in "12" for axis in "xy"]
    return [pair for pair in named if all(name in trial.channels for name in pair)]
