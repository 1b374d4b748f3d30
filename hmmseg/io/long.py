"""Recordings read piece by piece: a long file in bounded memory, as often as its rows are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.columns import source_of
from hmmseg.io.formats import kind_of, pieces_of, rows_of, split_part
from hmmseg.io.rig import Rig
from hmmseg.io.trial import MIN_SAMPLES, Trial, channels_of, trial_of

PIECE = 20_000  # numerics: rows of one piece; a piece of 50,000 rows and what is made of it takes 20 MB more
JUDGED = 50_000  # numerics: rows at the beginning by which a recording's habits are judged
LONG = 1_000_000  # numerics: rows from which on a recording is read in pieces: 13 columns of it are 100 MB


def is_long(path: str | Path) -> bool:
    """Whether a file has so many rows, and is of a kind, that it is read in pieces."""
    file, part = split_part(path)
    rows = None if part is not None or file.is_dir() else rows_of(file, kind_of(file))
    return rows is not None and rows >= LONG


class LongRecording:
    """A recording of a hand of two fingers on disk: its times, and any of its rows.

    `file`: its path; `t` (num_timesteps,) [s]; `rate`: their median one [Hz]. Rows are read
    fastest in their order. InputError as `read_trial`.
    """

    def __init__(self, path: str | Path, rig: Rig, piece: int = PIECE) -> None:
        self.path, self.rig, self.piece = Path(path), rig, piece
        self.file = str(path)
        self._origin: int | None = None
        self._kept: list[tuple[int, Trial]] = []  # pieces in memory, with the number of their first row
        self._rest: Iterator[Trial] = iter(())
        self.t = np.empty(rows_of(self.path, kind_of(self.path)) or 0)
        row, last = 0, -np.inf
        for trial in self._pieces():
            if trial.t[0] <= last:
                raise InputError(f"{path}: row {row + 1}, column t", f"{trial.t[0]:g} after {last:g}",
                                 "strictly increasing times")  # fmt: skip
            self.t[row : row + trial.t.size] = trial.t
            row, last = row + trial.t.size, trial.t[-1]
        self.rate = float(1.0 / np.median(np.diff(self.t)))

    def rows(self, start: int, stop: int) -> Trial:
        """The rows start <= i < stop as a trial of their own."""
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
        """As many rows as its habits are judged by."""
        return self.rows(0, min(JUDGED, self.t.size))

    @property
    def _last(self) -> int:
        first, trial = self._kept[-1]
        return first + trial.t.size

    def _pieces(self) -> Iterator[Trial]:
        """All pieces in order; times count from the first one's zero."""
        from hmmseg.hand.roll import levelled  # which reads trials itself

        names, _ = channels_of(self.rig, None)
        wanted = [source_of(name, self.rig.columns) for name in ("t", *(names or ()))]
        for table in pieces_of(self.path, wanted, self.piece, MIN_SAMPLES):
            trial = levelled(trial_of(table, self.rig, None, whole=False))
            if trial.origin is not None:
                self._origin = trial.origin if self._origin is None else self._origin
                trial = replace(trial, t=trial.t + (trial.origin - self._origin) * 1e-9)
            yield trial
