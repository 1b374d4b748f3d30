"""`Watcher`: rows of a recording as they come, in whatever order and at whatever pace."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.online.answer import Answer
from hmmseg.online.filter import Filter

LAG = 1.0  # chosen: s, unless another is wanted: contacts ring for a fifth of that
SNAPSHOTS = 10  # chosen: points over the lag to which a late row returns
GAP = 3.0  # chosen: usual intervals between rows that make a gap
USUAL = 0.02  # chosen: how fast the usual interval follows


class Watcher:
    """Follows one performance of a task of blocks, row by row.

        watcher = Watcher("task.toml", "rig.toml")
        for t, channels in rows:                # channels: in the order of watcher.channels, or a dict
            answer = watcher.update(t, channels)
            print(answer.subtask.name, answer.probabilities, answer.fits)
        final = watcher.finish()

    `lag` [s]: how long a boundary is waited for before it is settled. Time and memory a row do not grow.
    A late row is put in its place as long as that is within the lag; `counts` says how many rows were late,
    repeated, or followed a gap. InputError for a plain ordered task or a gripper with a wrist sensor.
    """

    def __init__(self, task: Any, rig: Any, lag: float = LAG) -> None:
        description, hand = Task.read(task), Rig.read(rig)
        if not isinstance(description, BlockTask):
            raise InputError("task", "a plain ordered task cannot be watched", "objects and moves")
        if hand.gripper is not None:
            raise InputError("rig", "a [gripper] cannot be watched", "[fingers], or a Cartesian hand")
        if not 0 <= lag < math.inf:
            raise InputError("lag", f"found {lag}", "0 s or more")
        self.filter = Filter(description, hand, float(lag))
        self.channels, self.optional = self.filter.channels, self.filter.optional
        self.counts: Counter[str] = Counter()
        self._snapshots: deque[tuple[float, Any]] = deque()
        self._every = max(float(lag), 0.1) / SNAPSHOTS
        self._usual = 1.0 / hand.rate if hand.rate else math.nan

    @property
    def lag(self) -> float:
        """How long a boundary is waited for [s]."""
        return self.filter.lag

    def update(self, t: float, channels: Sequence[float] | Mapping[str, float] | np.ndarray) -> Answer:
        """One row: time [s] and the channels in SI units, NaN where missing.

        Missing velocities of a Cartesian hand, NaN throughout, are derived from positions. The answer is of
        the newest row; its `note` says what was odd about this one.
        """
        if isinstance(channels, Mapping):
            channels = [channels.get(name, math.nan) for name in self.channels]
        row = np.array(channels, dtype=np.float64)
        if row.shape != (len(self.channels),):
            expected = f"({len(self.channels)},): {', '.join(self.channels)}"
            raise ValueError(f"channels: shape {row.shape}, expected {expected}")
        if not math.isfinite(t):
            raise ValueError(f"t: {t}, expected a time in s")
        self.counts["rows"] += 1
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
        answer = f.answer()
        answer.note = note
        return answer

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
                return f"repeated: the row at {t:.9g} s came before, and counts once"
            self.counts["contradictory"] += 1
            return f"contradictory: another row at {t:.9g} s came before; the first one counts"
        while len(self._snapshots) > 1 and self._snapshots[-1][0] >= t:
            self._snapshots.pop()
        if self._snapshots[0][0] >= t:
            self.counts["too late"] += 1
            return f"too late: {newest - t:.3g} s behind, more than the lag of {self.lag:g} s; left out"
        self.counts["late"] += 1
        taken = f.restore(self._snapshots[-1][1])
        for at, each in sorted([*taken, (t, row)], key=lambda pair: pair[0]):
            f.take(at, each)
        return f"late: {newest - t:.3g} s behind, put in its place"

    def finish(self) -> Answer:
        """The last answer: every boundary that has come is settled, whatever its age."""
        return self.filter.finish()

    @property
    def crossings(self) -> list:
        """The boundaries settled so far."""
        return self.filter.crossings
