"""`Watcher`: rows of a recording as they come, in whatever order and at whatever pace."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.signals import level_row
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import ROLL
from hmmseg.levels import GAP
from hmmseg.online.answer import Answer
from hmmseg.online.filter import Filter
from hmmseg.online.wrist import Wrist, checked

LAG = 1.0  # chosen: s, unless another is wanted: contacts ring for a fifth of that
SNAPSHOTS = 10  # numerics: points over the lag to which a late row returns
USUAL = 0.02  # numerics: how fast the usual interval follows
ODD = {
    "repeated": "repeated: the row at {t:.9g} s came before, and counts once",
    "contradictory": "contradictory: another row at {t:.9g} s came before; the first one counts",
    "too late": "too late: {behind:.3g} s behind, more than the lag of {lag:g} s; left out",
    "late": "late: {behind:.3g} s behind, put in its place",
}


class Watcher:
    """Follows one performance of a task of blocks, row by row.

        watcher = Watcher("task.toml", "rig.toml")
        for t, channels in rows:                # channels: in the order of watcher.channels, or a dict
            answer = watcher.update(t, channels)
            print(answer.subtask.name, answer.probabilities, answer.fits)
        final = watcher.finish()

    `lag` [s]: how long a boundary is waited for before it is settled. Time and memory a row do not grow.
    A late row is put in its place as long as that is within the lag; `counts` says how many rows were late,
    repeated, or followed a gap. A gripper with a sensor in its wrist is followed a smoothing window late,
    from its first grip on (`hmmseg.online.wrist`). InputError for a plain ordered task.
    """

    def __init__(self, task: Any, rig: Any, lag: float = LAG) -> None:
        description, hand = Task.read(task), Rig.read(rig)
        if not isinstance(description, BlockTask):
            raise InputError("task", "a plain ordered task cannot be watched", "objects and moves")
        if not 0 <= lag < math.inf:
            raise InputError("lag", f"found {lag}", "0 s or more")
        self.filter = Filter(description, hand, float(lag))
        self._wrist = None if hand.gripper is None else Wrist(hand)
        self.channels, self.optional = self.filter.channels, self.filter.optional
        if not hand.jointed and self._wrist is None:
            self.channels, self.optional = (*self.channels, ROLL), (*self.optional, ROLL)
        if self._wrist is not None:
            self.channels, self.optional = self._wrist.names, ()
        self.counts: Counter[str] = Counter()
        self._mark: Any = None  # where the last grip of a wrist's gripper began
        self._snapshots: deque[tuple[float, Any]] = deque()
        self._roll = 0.0  # of the hand, as last recorded [rad]
        self._every = max(float(lag), 0.1) / SNAPSHOTS
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
            InputError: for an orientation that cannot be, or lifts that pull up.
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
        f = self.filter
        note = self._followed(t, row) if self._wrist is None else self._felt(self._wrist, t, row)
        answer = f.answer()
        answer.note = note
        return answer

    def _level(self, row: np.ndarray) -> np.ndarray:
        """The row as a level hand's; while its roll is missing it is taken to be the last one."""
        if not math.isnan(row[-1]):
            self._roll = float(row[-1])
        return level_row(row[:-1], self._roll) if self._roll else row[:-1]

    def _followed(self, t: float, row: np.ndarray) -> str | None:
        """Take a row, in its place; what was irregular about it."""
        f, note = self.filter, None
        rows = f.rows
        if rows and t <= rows[-1][0]:
            note = self._out_of_order(t, row)
        else:
            if rows:
                note = self._gap(t - rows[-1][0])
            if not self._snapshots or t >= self._snapshots[-1][0] + self._every:
                self._snapshots.append((rows[-1][0] if rows else -math.inf, f.snapshot()))
                while len(self._snapshots) > SNAPSHOTS + 1:
                    self._snapshots.popleft()
            f.take(t, row)
        return note

    def _felt(self, wrist: Wrist, t: float, row: np.ndarray) -> str | None:
        """Take a row of a wrist's sensor; what was irregular about it."""
        checked(self.filter.rig, t, row)
        newest = wrist.newest
        stray = wrist.place(t, row)
        if stray is None:
            note = None if math.isnan(newest) else self._gap(t - newest)
        else:
            self.counts[stray] += 1
            note = ODD[stray].format(t=t, behind=newest - t, lag=wrist.delay)
        self._take_felt(wrist, wrist.ready())
        self.filter.idle(t)
        return note

    def _take_felt(self, wrist: Wrist, rows: list[tuple[float, np.ndarray]]) -> None:
        f = self.filter
        if wrist.tool is None:
            return
        if f.force_noise is None:  # each finger has half of the sensor's, and their sum all of it
            f.force_noise = wrist.tool.noise / math.sqrt(2)
            f.together = max(f.together, wrist.delay)  # what is smoothed errs alike for as long as the window
        f.touches, f.properties.touch_sd = wrist.touches, wrist.touch_sd
        f.properties.force_sd = wrist.force_sd
        if wrist.back and self._mark is not None:
            f.restore(self._mark)
        wrist.back = False
        for t, row in rows:
            if wrist.mark is not None and t >= wrist.mark:
                self._mark, wrist.mark = f.snapshot(), None
            f.take(t, row)

    def _gap(self, dt: float) -> str | None:
        usual, self._usual = self._usual, dt if math.isnan(self._usual) else self._usual
        self._usual += USUAL * (min(dt, GAP * self._usual) - self._usual)
        if not dt > GAP * usual:
            return None
        self.counts["gaps"] += 1
        return f"gap: {dt:.3g} s since the row before"

    def _out_of_order(self, t: float, row: np.ndarray) -> str:
        f = self.filter
        newest = f.rows[-1][0]
        same = next((old for at, old in reversed(f.rows) if at == t), None)
        if same is not None:
            if np.array_equal(same, row, equal_nan=True):
                self.counts["repeated"] += 1
                return ODD["repeated"].format(t=t)
            self.counts["contradictory"] += 1
            return ODD["contradictory"].format(t=t)
        while len(self._snapshots) > 1 and self._snapshots[-1][0] >= t:
            self._snapshots.pop()
        if self._snapshots[0][0] >= t:
            self.counts["too late"] += 1
            return ODD["too late"].format(behind=newest - t, lag=self.lag)
        self.counts["late"] += 1
        taken = f.restore(self._snapshots[-1][1])
        for at, each in sorted([*taken, (t, row)], key=lambda pair: pair[0]):
            f.take(at, each)
        return ODD["late"].format(behind=newest - t)

    def finish(self) -> Answer:
        """The last answer: every boundary that has come is settled, whatever its age."""
        if self._wrist is not None:
            self._take_felt(self._wrist, self._wrist.ready(final=True))
        return self.filter.finish()

    @property
    def crossings(self) -> list:
        """The boundaries settled so far."""
        return self.filter.crossings
