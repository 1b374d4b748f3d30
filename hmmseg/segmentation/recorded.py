"""Signals that are in memory, or read from disk as they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, overload, runtime_checkable

import numpy as np

from hmmseg.hand.grouping import group_size
from hmmseg.hand.rates import come_late, differenced
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.long import LongRecording
from hmmseg.io.rig import Rig
from hmmseg.segmentation.features import thin
from hmmseg.segmentation.rounds import part

MARGIN = 64  # numerics: rows read on either side of a part, for differences of its neighbours


@runtime_checkable
class Recorded(Protocol):
    """One recording's times (num_timesteps,) [s], and the signals of any of its samples."""

    @property
    def t(self) -> np.ndarray:
        """Times (num_timesteps,) [s]."""
        ...

    def part(self, samples: slice) -> Signals:
        """Signals of some samples."""
        ...


@dataclass(frozen=True)
class InMemory:
    """Signals that are at hand."""

    signals: Signals

    @property
    def t(self) -> np.ndarray:
        """Times (num_timesteps,) [s]."""
        return self.signals.t

    def part(self, samples: slice) -> Signals:
        """Signals of some samples."""
        return part(self.signals, samples)


class OnDisk:
    """Signals read anew whenever they are asked for.

    Whether velocities come late is judged by its beginning: a drive does not change its habits.
    """

    def __init__(self, recording: LongRecording, rig: Rig) -> None:
        self.recording, self.rig = recording, rig
        self._late = come_late(recording.beginning(), rig)

    @property
    def t(self) -> np.ndarray:
        """Times (num_timesteps,) [s]."""
        return self.recording.t

    def part(self, samples: slice) -> Signals:
        """Signals of some samples."""
        start, stop = samples.start, samples.stop
        low, high = max(start - MARGIN, 0), min(stop + MARGIN, self.t.size)
        signals = task_space(self.recording.rows(low, high), self.rig)
        if self._late:
            signals = differenced(signals)
        return part(signals, slice(start - low, stop - low))

    def thinned(self, max_rate: float) -> Signals:
        """All of it, at a rate of at most `max_rate` [Hz], as `thin` has it."""
        rate = self.recording.rate
        step = group_size(rate, max_rate)
        size = max(self.recording.piece // step, 1) * step
        pieces = [
            thin(self.part(slice(start, min(start + size, self.t.size))), max_rate, rate=rate)
            for start in range(0, self.t.size, size)
        ]
        joined = {
            name: np.concatenate([getattr(p, name) for p in pieces])
            if isinstance(value, np.ndarray)
            else value
            for name, value in vars(pieces[0]).items()
        }
        return Signals(**joined)  # type: ignore[arg-type]


class Parts(Sequence[Signals]):
    """Parts of recordings, read whenever one is asked for."""

    def __init__(self, parts: Sequence[tuple[Recorded, slice]]) -> None:
        self.parts = list(parts)

    def __len__(self) -> int:
        return len(self.parts)

    @overload
    def __getitem__(self, i: int) -> Signals: ...
    @overload
    def __getitem__(self, i: slice) -> Parts: ...
    def __getitem__(self, i: int | slice) -> Signals | Parts:
        if isinstance(i, slice):
            return Parts(self.parts[i])
        recorded, samples = self.parts[i]
        return recorded.part(samples)
