"""`Watcher`: rows of a recording as they come, at whatever pace."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.roll import level_row
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import ROLL
from hmmseg.levels import GAP
from hmmseg.online.answer import Answer
from hmmseg.online.filter import Filter

LAG = 1.0  # chosen: s, unless another is wanted: contacts ring for a fifth of that
USUAL = 0.02  # numerics: how fast the usual interval follows


class Watcher:
    """Follows one performance of a task of blocks, row by row.

        watcher = Watcher("task.toml", "rig.toml")
        for t, channels in rows:                # channels: in the order of watcher.channels, or a dict
            answer = watcher.update(t, channels)
            print(answer.subtask.name, answer.probabilities, answer.fits)
        final = watcher.finish()

    `lag` [s]: how long a boundary is waited for before it is settled. Time and memory a row do not grow.
    A row that is not later than the one before is left out; `counts` says how many were late, repeated, or
    followed a gap. InputError for a plain ordered task, and for a gripper with a sensor in its wrist, whose
    share of the load is known from the whole recording alone.
    """

    def __init__(self, task: Any, rig: Any, lag: float = LAG) -> None:
        description, hand = Task.read(task), Rig.read(rig)
        if not isinstance(description, BlockTask):
            raise InputError("task", "a plain ordered task cannot be watched", "objects and moves")
        if hand.gripper is not None:
            problem = "a gripper with a sensor in its wrist cannot be watched"
            raise InputError("[gripper]", problem, "fingers that feel; hmmseg segment reads such recordings")
        if not 0 <= lag < math.inf:
            raise InputError("lag", f"found {lag}", "0 s or more")
        self.filter = Filter(description, hand, float(lag))
        self.channels, self.optional = self.filter.channels, self.filter.optional
        if not hand.jointed:
            self.channels, self.optional = (*self.channels, ROLL), (*self.optional, ROLL)
        self.counts: Counter[str] = Counter()
        self._roll = 0.0  # of the hand, as last recorded [rad]
        self._usual = 1.0 / hand.rate if hand.rate else math.nan

    @property
    def forces(self) -> tuple[float, float]:
        """Grip and net vertical force of the newest row that was read [N], NaN before the first."""
        rows = self.filter.rows
        if not rows:
            return math.nan, math.nan
        fx1, fy1, fx2, fy2 = rows[-1][1][[4, 5, 10, 11]]
        return float(fx1 - fx2) / 2, float(fy1 + fy2)

    @property
    def lag(self) -> float:
        """How long a boundary is waited for [s]."""
        return self.filter.lag

    def update(self, t: float, channels: Sequence[float] | Mapping[str, float] | np.ndarray) -> Answer:
        """Take one row.

        Args:
            t: its time [s].
            channels: one number for each of `channels` in that order, or a dict by name; SI units, NaN where
                missing. Velocities of a Cartesian hand that are always missing are derived from positions.

        Returns:
            What is known at the newest row; `note` says what was irregular about this one.

        Raises:
            ValueError: for another number of channels, or a time that is not finite.
        """
        if isinstance(channels, Mapping):
            channels = [channels.get(name, math.nan) for name in self.channels]
        row = np.array(channels, dtype=np.float64)
        rolls = ROLL in self.channels  # which stands last, and may be left out
        if rolls and row.shape == (len(self.channels),):
            row = self._level(row)
        if row.shape != (len(self.channels) - rolls,):
            expected = f"({len(self.channels)},): {', '.join(self.channels)}"
            raise ValueError(f"channels: shape {row.shape}, expected {expected}")
        if not math.isfinite(t):
            raise ValueError(f"t: {t}, expected a time in s")
        self.counts["rows"] += 1
        note = self._followed(t, row)
        answer = self.filter.answer()
        answer.note = note
        return answer

    def _level(self, row: np.ndarray) -> np.ndarray:
        """The row as a level hand's; while its roll is missing it is taken to be the last one."""
        if not math.isnan(row[-1]):
            self._roll = float(row[-1])
        return level_row(row[:-1], self._roll) if self._roll else row[:-1]

    def _followed(self, t: float, row: np.ndarray) -> str | None:
        """Take a row unless it is not later than the one before; what was irregular about it."""
        rows = self.filter.rows
        behind = rows[-1][0] - t if rows else -math.inf
        if behind == 0 and np.array_equal(rows[-1][1], row, equal_nan=True):
            self.counts["repeated"] += 1
            return f"repeated: the row at {t:.9g} s came before, and counts once"
        if behind >= 0:
            self.counts["late"] += 1
            return f"late: {behind:.3g} s behind the row before; left out"
        note = self._gap(-behind) if rows else None
        self.filter.take(t, row)
        return note

    def _gap(self, dt: float) -> str | None:
        usual, self._usual = self._usual, dt if math.isnan(self._usual) else self._usual
        self._usual += USUAL * (min(dt, GAP * self._usual) - self._usual)
        if not dt > GAP * usual:
            return None
        self.counts["gaps"] += 1
        return f"gap: {dt:.3g} s since the row before"

    def finish(self) -> Answer:
        """The last answer: every boundary that has come is settled, whatever its age."""
        return self.filter.finish()

    @property
    def crossings(self) -> list:
        """The boundaries settled so far."""
        return self.filter.crossings
