"""Read recordings from any source, map, check and convert them to two fingers.

A long file is read piece by piece, in bounded memory, as often as its rows are needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.plausibility import (
    Finding,
    check_angles,
    check_axes,
    check_clock,
    check_forces,
    check_lengths,
    check_signs,
    check_velocities,
    judge,
)
from hmmseg.hand.sensing import SPARSE, check_noise, check_steps, remove_faults
from hmmseg.hand.signals import remove_roll
from hmmseg.hand.wrist import check_gripper, is_halved, join_halves, two_fingers
from hmmseg.io.formats import LOGS, kind_of, pieces_of, read_table, rows_of, split_part
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.table import frame_table
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import MIN_SAMPLES, Trial, channels_of, trial_of
from hmmseg.io.units import Column, source_of

PIECE = 20_000  # numerics: rows of one piece; one of 50,000 rows and its results take 20 MB more
JUDGED = 50_000  # numerics: rows at the beginning by which a long recording is checked
LONG = 1_000_000  # numerics: rows from which a recording is read in pieces: 13 columns of it are 100 MB


def read_trial(source: str | Path | Any, rig: Rig | None = None, task: SequenceTask | None = None) -> Trial:
    """Read and check one recording.

    Channels are the rig's (joint space, Cartesian or a gripper's), or those that a plain ordered task names
    (every column but `t` by default), from the columns or messages to which `[columns]` or `[topics]` map
    them.

    Args:
        source: a file, a pandas or polars DataFrame, or a dict of arrays.
        rig: the hand; a plain ordered task needs none.
        task: a plain ordered task; None for a task of blocks.

    Returns:
        The trial, in SI units.

    Raises:
        InputError: the file cannot be read, or the recording contradicts its description (other units,
            flipped signs, swapped fingers); it says where, and what to write into the rig.
        ValueError: neither a rig nor a task is given.
    """
    if task is None and rig is None:
        raise ValueError("a block task's trial needs its rig")
    names, _ = channels_of(rig, task)
    log = isinstance(source, str | Path) and kind_of(split_part(source)[0]) in LOGS
    columns: Mapping[str, Column] = {} if rig is None else (rig.topics if log else rig.columns)
    theirs = None if names is None else [source_of(name, columns) for name in ("t", *names)]
    read = read_table if isinstance(source, str | Path) else frame_table
    table = read(source, theirs)
    trial = trial_of(table, rig, task)
    if task is not None or rig is None:
        warnings = judge(trial, check_clock(trial, rig, moving=False))
        return replace(trial, warnings=(*trial.warnings, *warnings))
    trial = remove_faults(trial, rig)
    warnings = check(trial, rig)
    trial = remove_roll(trial)
    if not rig.jointed:
        trial = check_steps(trial, rig)
    if rig.gripper is not None:
        trial = two_fingers(trial, rig)
    elif is_halved(trial):
        trial = join_halves(trial, rig)
    return replace(trial, warnings=(*trial.warnings, *warnings))


def findings(trial: Trial, rig: Rig) -> list[Finding]:
    """Findings about a trial, up to and including the first certain one.

    Units are checked first: signs of a hand that travels 120 m mean nothing.
    """
    out: list[Finding] = []
    looks = [check_clock, check_lengths, check_angles, check_velocities, check_forces]
    if not is_halved(trial):  # forces of a wrist have no sides
        forces = [trial.channels[name] for name in FORCE_CHANNELS if name in trial.channels]
        felt = all(np.mean(np.isnan(force)) < SPARSE for force in forces)  # often enough to judge signs by
        looks += [check_noise, check_axes, check_signs] if felt else [check_noise]
    if rig.gripper is not None:
        looks = [check_clock, check_lengths, check_gripper]
    for look in looks:
        for finding in look(trial, rig):
            mapped = "topics" if any(name in rig.topics for name in finding.changes) else "columns"
            out.append(replace(finding, table=mapped))
            if finding.certain:
                return out
    return out


def check(trial: Trial, rig: Rig) -> tuple[str, ...]:
    """Warnings about a trial; InputError for what is impossible."""
    return judge(trial, findings(trial, rig))


def is_long(path: str | Path) -> bool:
    """Whether a file is of a kind, and has so many rows, that it is read in pieces."""
    file, part = split_part(path)
    rows = None if part is not None or file.is_dir() else rows_of(file, kind_of(file))
    return rows is not None and rows >= LONG


class LongRecording:
    """A recording of a hand of two fingers on disk.

    `file`: its path; `t` (num_timesteps,) [s]; `rate`: the median one [Hz]. Reading rows in order is fastest.
    InputError as in `read_trial`.
    """

    def __init__(self, path: str | Path, rig: Rig, piece: int = PIECE) -> None:
        self.path, self.rig, self.piece = Path(path), rig, piece
        self.file = str(path)
        self._origin: int | None = None
        self._kept: list[tuple[int, Trial]] = []  # pieces in memory, each with the number of its first row
        self._rest: Iterator[Trial] = iter(())
        self.t = np.empty(rows_of(self.path, kind_of(self.path)) or 0)
        row, last = 0, -np.inf
        for trial in self._pieces():
            if trial.t[0] <= last:
                raise InputError(f"{path}: row {row + 1}, column t", f"{trial.t[0]:.13g} after {last:.13g}",
                                 "strictly increasing times")  # fmt: skip
            self.t[row : row + trial.t.size] = trial.t
            row, last = row + trial.t.size, trial.t[-1]
        self.rate = float(1.0 / np.median(np.diff(self.t)))

    def rows(self, start: int, stop: int) -> Trial:
        """The rows start <= i < stop as a trial."""
        if not self._kept or self._kept[0][0] > start:
            self._kept, self._rest = [], self._pieces()
        while not self._kept or self._last < stop:
            first = self._last if self._kept else 0
            self._kept.append((first, next(self._rest)))
            while len(self._kept) > 1 and self._kept[1][0] <= start:
                del self._kept[0]
        first = self._kept[0][0]
        trials = [trial for _, trial in self._kept]
        names = [n for n in trials[0].channels if all(n in each.channels for each in trials)]
        return Trial(
            self.file, self.t[start:stop],
            {n: np.concatenate([e.channels[n] for e in trials])[start - first : stop - first] for n in names},
            self._origin,
        )  # fmt: skip

    def beginning(self) -> Trial:
        """The rows at the beginning by which the recording is checked."""
        return self.rows(0, min(JUDGED, self.t.size))

    @property
    def _last(self) -> int:
        first, trial = self._kept[-1]
        return first + trial.t.size

    def _pieces(self) -> Iterator[Trial]:
        """All pieces in order, on the clock of the first."""
        names, _ = channels_of(self.rig, None)
        wanted = [source_of(name, self.rig.columns) for name in ("t", *(names or ()))]
        for table in pieces_of(self.path, wanted, self.piece, MIN_SAMPLES):
            trial = remove_roll(trial_of(table, self.rig, None, whole=False))
            if trial.origin is not None:
                self._origin = trial.origin if self._origin is None else self._origin
                trial = replace(trial, t=trial.t + (trial.origin - self._origin) * 1e-9)
            yield trial
