"""`Watcher`: follows a recording row by row as it arrives, in any order and at any pace."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.plausibility import check_angles, check_clock, check_lengths
from hmmseg.hand.signals import level_row
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import ROLL, Trial
from hmmseg.levels import GAP
from hmmseg.online.answer import Answer, Crossing
from hmmseg.online.filter import Filter
from hmmseg.online.wrist import LAG, Wrist, checked

SNAPSHOTS = 10  # numerics: points per lag to which a late row can return
USUAL = 0.02  # numerics: update rate of the usual interval
JUDGED = 20  # numerics: rows of which one is looked at for readings that no hand has
ODD = {
    "repeated": "repeated: the row at {t:.9g} s came before, and counts once",
    "contradictory": "contradictory: another row at {t:.9g} s came before; the first one counts",
    "too late": "too late: {behind:.3g} s behind, more than the lag of {lag:g} s; left out",
    "late": "late: {behind:.3g} s behind, put in its place",
}


class Watcher:
    """Follows one performance of a block task, row by row.

        watcher = Watcher("task.toml", "rig.toml")
        for t, channels in rows:                # channels: in the order of watcher.channels, or a dict
            answer = watcher.update(t, channels)
            print(answer.subtask.name, answer.probabilities, answer.fits)
        final = watcher.finish()

    `lag` [s]: delay after which a boundary is settled. Time and memory per row are bounded. A late row is
    inserted in its place if it is within the lag; `counts` tells how many rows were late, repeated, or
    followed a gap. A gripper with a sensor in its wrist is followed with the delay of a smoothing window,
    from its first grip on (`hmmseg.online.wrist`). InputError for a plain ordered task.
    """

    def __init__(self, task: Any, rig: Any, lag: float = LAG) -> None:
        description, hand = Task.read(task), Rig.read(rig)
        if not isinstance(description, BlockTask):
            raise InputError("task", "a plain ordered task cannot be watched", "objects and moves")
        if not 0 <= lag < math.inf:
            raise InputError("lag", f"found {lag}", "0 s or more")
        self.lag, self.filter = float(lag), Filter(description, hand, float(lag))
        self._wrist = None if hand.gripper is None else Wrist(hand)
        self.channels: tuple[str, ...] = self.filter.channels
        self.optional: tuple[str, ...] = self.filter.optional
        if not hand.jointed and self._wrist is None:
            self.channels, self.optional = (*self.channels, ROLL), (*self.optional, ROLL)
        if self._wrist is not None:
            self.channels, self.optional = self._wrist.names, ()
        self.counts: Counter[str] = Counter()
        self._mark: Any = None  # snapshot of the start of a wrist gripper's last grip
        self._snapshots: deque[tuple[float, Any]] = deque(maxlen=SNAPSHOTS + 1)
        self._looked: deque[tuple[float, np.ndarray]] = deque(maxlen=3)
        self._ends = np.full((2, 1), np.nan)  # least and greatest of the middle ones
        self._roll = 0.0  # last recorded roll of the hand [rad]
        self._every = max(float(lag), 0.1) / SNAPSHOTS
        self._usual = 1.0 / hand.rate if hand.rate else math.nan

    @property
    def forces(self) -> tuple[float, float]:
        """Grip and net vertical force of the newest row [N], NaN before the first."""
        rows = self.filter.rows
        if not rows:
            return math.nan, math.nan
        fx1, fy1, fx2, fy2 = rows[-1][1][[4, 5, 10, 11]]
        return float(fx1 - fx2) / 2, float(fy1 + fy2)

    def update(self, t: float, channels: Sequence[float] | Mapping[str, float] | np.ndarray) -> Answer:
        """Process one row.

        Args:
            t: its time [s].
            channels: one number for each of `channels` in that order, or a dict by name; SI units, NaN where
                missing. Velocities of a Cartesian hand that are always missing are derived from positions.

        Returns:
            The answer at the newest row; its `note` describes an irregularity of this row.

        Raises:
            ValueError: for another number of channels, or a time that is not finite.
            InputError: for an impossible orientation, positions or angles, or lifts that pull up.
        """
        if isinstance(channels, Mapping):
            channels = [channels.get(name, math.nan) for name in self.channels]
        row = np.array(channels, dtype=np.float64)
        rolls = ROLL in self.channels  # the last channel, may be left out
        if rolls and row.shape == (len(self.channels),):
            row = self._level(row)
        if row.shape != (len(self.channels) - rolls,):
            expected = f"({len(self.channels)},): {', '.join(self.channels)}"
            raise ValueError(f"channels: shape {row.shape}, expected {expected}")
        if not math.isfinite(t):
            raise ValueError(f"t: {t}, expected a time in s")
        self.counts["rows"] += 1
        if self.counts["rows"] % JUDGED == 0:
            self._check_units(t, row)
        note = self._take(t, row) if self._wrist is None else self._take_wrist(self._wrist, t, row)
        answer = self.filter.answer()
        answer.note = note
        return answer

    def _level(self, row: np.ndarray) -> np.ndarray:
        """The row as a level hand's; a missing roll is taken to be the last one."""
        if not math.isnan(row[-1]):
            self._roll = float(row[-1])
        return level_row(row[:-1], self._roll) if self._roll else row[:-1]

    def _check_units(self, t: float, row: np.ndarray) -> None:
        """InputError once readings show what no hand does, such as millimetres taken for m, or ms for s."""
        self._looked.append((t, row))
        times, rows = (np.array(each) for each in zip(*self._looked, strict=True))
        middle = np.sort(rows, axis=0)[len(rows) // 2]  # of three: one may be wild
        self._ends = np.array([np.fmin(self._ends[0], middle), np.fmax(self._ends[1], middle)])
        ends = dict(zip(self.channels, self._ends.T, strict=False))
        period = np.diff(times).min(initial=np.inf) / JUDGED  # a gap is in one of two
        known = times.size == self._looked.maxlen and period > 0
        trial, rig = Trial("stream", t + np.array([0.0, period if known else 1.0]), ends), self.filter.rig
        clock = check_clock(trial, rig) if known else []
        for found in (*clock, *check_lengths(trial, rig), *check_angles(trial, rig)):
            if found.certain:  # which other columns are in this unit may not show yet
                several = f'{found.channel} = {{unit = "..."}} and the like under [columns] in rig.toml'
                remedy = found.remedy if found in clock else several
                raise InputError(f"stream: column {found.channel}", found.problem, remedy)

    def _take(self, t: float, row: np.ndarray) -> str | None:
        """Process a row; returns its irregularity."""
        rows = self.filter.rows
        newest = rows[-1][0] if rows else -math.inf
        if t <= newest:
            return self._out_of_order(t, row)
        note = self._gap(t - newest) if rows else None
        if not self._snapshots or t >= self._snapshots[-1][0] + self._every:
            self._snapshots.append((newest, self.filter.snapshot()))
        self.filter.take(t, row)
        return note

    def _take_wrist(self, wrist: Wrist, t: float, row: np.ndarray) -> str | None:
        """Process a row of a wrist's sensor; returns its irregularity."""
        checked(self.filter.rig, t, row)
        newest = wrist.newest
        irregular = wrist.place(t, row)
        if irregular is None:
            note = None if math.isnan(newest) else self._gap(t - newest)
        else:
            note = self._odd(irregular, t, newest - t, wrist.delay)
        self._forward(wrist, wrist.ready())
        self.filter.idle(t)
        return note

    def _odd(self, kind: str, t: float, behind: float, lag: float) -> str:
        """Count an irregular row and describe it."""
        self.counts[kind] += 1
        return ODD[kind].format(t=t, behind=behind, lag=lag)

    def _forward(self, wrist: Wrist, rows: list[tuple[float, np.ndarray]]) -> None:
        """Pass rows of the wrist's virtual fingers, with what it knows of them, on to the filter."""
        f = self.filter
        if wrist.tool is None:
            return
        if f.force_noise is None:  # so that the sum of both fingers has the sensor's noise
            f.force_noise = wrist.tool.noise / math.sqrt(2)
            f.together = max(f.together, wrist.delay)  # smoothing correlates errors over its window
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
        """Update the usual interval by `dt` [s]; returns a note if that is a gap."""
        usual, self._usual = self._usual, dt if math.isnan(self._usual) else self._usual
        self._usual += USUAL * (min(dt, GAP * self._usual) - self._usual)
        if not dt > GAP * usual:
            return None
        self.counts["gaps"] += 1
        return f"gap: {dt:.3g} s since the row before"

    def _out_of_order(self, t: float, row: np.ndarray) -> str:
        """Process a row that is not the newest; returns its irregularity."""
        f = self.filter
        newest = f.rows[-1][0]
        same = next((old for at, old in reversed(f.rows) if at == t), None)
        if same is not None:
            kind = "repeated" if np.array_equal(same, row, equal_nan=True) else "contradictory"
            return self._odd(kind, t, newest - t, self.lag)
        while len(self._snapshots) > 1 and self._snapshots[-1][0] >= t:
            self._snapshots.pop()
        if self._snapshots[0][0] >= t:
            return self._odd("too late", t, newest - t, self.lag)
        taken = f.restore(self._snapshots[-1][1])
        for at, each in sorted([*taken, (t, row)], key=lambda pair: pair[0]):
            f.take(at, each)
        return self._odd("late", t, newest - t, self.lag)

    def finish(self) -> Answer:
        """The final answer, with all boundaries settled whatever their age; InputError if no row came."""
        if not self.counts["rows"]:
            raise InputError("the stream", "has no rows", "a row for every sample")
        if self._wrist is not None:
            self._forward(self._wrist, self._wrist.ready(final=True))
        return self.filter.finish()

    @property
    def crossings(self) -> list[Crossing]:
        """The boundaries settled so far."""
        return self.filter.crossings
