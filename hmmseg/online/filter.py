"""The filter of a block task: one row after another, nothing looked ahead beyond the lag.

The filter is over alignments with the blocks' unknown weights and widths: hypotheses that differ by when
each subtask began carry conjugate posteriors of everything else (a Rao-Blackwellised filter that
enumerates where a particle filter draws; Adams and MacKay 2007; Doucet et al. 2000). docs/watch.md.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING, Subtask, subtasks
from hmmseg.contact.equations import pads_of
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import CARTESIAN_CHANNELS, CARTESIAN_OPTIONAL, JOINT_CHANNELS
from hmmseg.online import layout as at
from hmmseg.online.answer import Answer, Crossing
from hmmseg.online.layout import Layout
from hmmseg.online.properties import Properties
from hmmseg.online.readings import HISTORY, ROWS, hand_row, read, widen
from hmmseg.online.refine import REACH, refined
from hmmseg.online.scores import CREEP
from hmmseg.online.step import LOG_DEPARTURE, advance
from hmmseg.online.summary import boundary, summarise
from hmmseg.segmentation.emissions import MAX_RATE, noise_sd

WARM_UP = 8  # numerics: rows that tell a force noise which the rig does not state
NUM_CHANNELS = len(CARTESIAN_CHANNELS)
KINDS = {FREE: at.FREE_KIND, ON_GROUND: at.GROUND_KIND, SLIDING: at.SLIDING_KIND, ABOVE_GROUND: at.ABOVE_KIND}
# chosen: where scales start, before the recording says better [m/s, m, m]; worth PRIOR readings. Chosen: a
# hand at rest creeps, and pads' foam gives by tenths of a mm.
VELOCITY, LEVEL, WIDTH = CREEP, 2e-4, 2e-4
PRIOR = 4.0  # prior: readings that a scale's start is worth
# prior: ranges of a hand before it has moved: vx, vy [m/s], y, d [m]; of no more weight than a few nats
LEAST_SPANS = (0.1, 0.1, 0.03, 0.03)
LEAST_FORCE = 50.0  # prior: and of its forces, in sds of their noise
ROUGH = 3.0  # prior: net and shear force of a held block at first, in sds of the force noise
UNBIASED = 10.0  # prior: a sensor's bias before anything is known, in sds of its noise


@dataclass
class _State:
    """All that changes from row to row; copied whole, it is a point to return to."""

    table: np.ndarray
    count: int
    history: np.ndarray
    head: int
    filled: int
    last_t: float
    last_row: np.ndarray
    since: float
    extremes: np.ndarray
    spans: np.ndarray
    settled: int
    started: bool
    num_rows: int = 0


class Filter:
    """Follows one performance of a task of blocks, its rows in order of time (see Watcher)."""

    def __init__(self, task: BlockTask, rig: Rig, lag: float) -> None:
        self.task, self.rig, self.lag = task, rig, lag
        self.channels = JOINT_CHANNELS if self.rig.jointed else CARTESIAN_CHANNELS
        self.optional = () if self.rig.jointed else CARTESIAN_OPTIONAL
        self.rows: deque[tuple[float, np.ndarray]] = deque()  # the last, over the lag and REACH before it
        self._prepare_task(task)
        self._prepare_hand(rig)
        self._written, self._written_t = "{}", -math.inf
        self.crossings: list[Crossing] = []
        self.first_t = math.nan  # of the first row [s]
        self.touches: list[tuple[float, float]] = []  # known apart from forces [s]
        self.together = 1.0 / MAX_RATE  # readings nearer to each other than this are no two [s]
        self._waiting: list[tuple[float, np.ndarray]] = []
        self._velocities = True
        width, rows = self.layout.width, 24 * len(self.kinds)
        self._fresh = np.zeros((len(self.kinds) + 2, width))
        self._x, self._row = np.full(at.NUM_READ, np.nan), np.zeros(12)
        self._x[at.SD_FX :] = 0.0, 0.0, 1.0
        self._now, self._smoothed = np.zeros(self.num_steps + 1), np.zeros(self.num_steps + 1)
        self._means = np.zeros((2 * self.layout.num_objects + self.layout.num_moves, 3))
        self._best, self._least = np.zeros(5), np.array(LEAST_SPANS)
        self._state = _State(
            np.zeros((rows, width)), 0, np.full((ROWS, HISTORY), np.nan), -1, 0, math.nan, np.zeros(12), 0.0,
            np.array([[np.inf, -np.inf]] * 4), np.array([*LEAST_SPANS, 1.0, 1.0]), 0, False,
        )  # fmt: skip

    def _prepare_task(self, task: BlockTask) -> None:
        from hmmseg.segmentation.rounds import one_round, round_tasks

        self.steps: tuple[Subtask, ...] = subtasks(one_round(task))
        self.num_steps = len(self.steps)
        names = list(task.objects)
        self.layout = Layout(len(names), len(task.moves))
        sliding = any(move.slide for move in task.moves)
        off: list[tuple[str, int]] = [(FREE, -1)]
        states = (ON_GROUND, ABOVE_GROUND, SLIDING) if sliding else (ON_GROUND, ABOVE_GROUND)
        off += [(state, o) for o in range(len(names) + 1) for state in states]
        own = [(s.state, -1 if s.state == FREE else names.index(str(s.object))) for s in self.steps]
        self.off_task = [(state, None if o < 0 else [*names, None][o]) for state, o in off]
        self.kinds = np.array([KINDS[state] for state, _ in own + off], dtype=np.int64)
        blocks = np.array([o for _, o in own + off], dtype=np.int64)
        repeats = 1000 if task.repeat == "unknown" else task.repeat
        self.num_rounds, self.cyclic = float(repeats), repeats > 1
        tasks = round_tasks(task, min(repeats, 2 * len(names) + 2))
        self.properties = Properties(task, tasks, self.rig)
        moves = np.array(
            [-1 if s.move is None or not self.properties.steady[s.move] else s.move for s in self.steps]
            + [-1] * len(off), dtype=np.int64,
        )  # fmt: skip
        self._chain = (self.kinds, blocks, moves, self.num_steps)

    def _prepare_hand(self, rig: Rig) -> None:
        self._geometry = np.zeros(8)
        if rig.jointed:
            fingers = [rig.finger(i) for i in (1, 2)]
            self._geometry[:] = [v for f in fingers for v in (*f.base, *f.links)]
        noise = rig.noise
        position = noise.angle if rig.jointed else noise.position
        self._noise = np.array([(position or 0.0) ** 2, (noise.velocity or 0.0) ** 2])
        self._pads = np.array(pads_of(rig), dtype=float)
        self.force_noise = noise.force

    def _begin(self, noise: float) -> None:
        """The one hypothesis to start from, and those of a recording that starts off its task."""
        s, h = self._state, np.zeros(self.layout.width)
        h[at.MISSED], h[at.LEFT_AT], h[at.ENTRY] = -1.0, math.inf, s.last_t
        bias = np.maximum(UNBIASED * noise, 3 * np.array(self.rig.systematic.force_bias))
        h[at.BIAS + 1 : at.BIAS + 8 : 2] = 1.0 / bias**2
        rough = ROUGH * noise
        for which, scale in enumerate((noise, rough, rough, rough, VELOCITY, LEVEL, WIDTH)):
            h[at.SCALES + 2 * which : at.SCALES + 2 * which + 2] = PRIOR * scale**2, PRIOR
        s.table[0] = h
        off = len(self.kinds) - self.num_steps
        for i in range(1, off):  # whatever is free motion at the start is the task's own
            s.table[i] = h
            s.table[i, at.STATE], s.table[i, at.MISSED] = self.num_steps + i, 0.0
            s.table[i, at.LEFT_AT], s.table[i, at.WEIGHT] = s.last_t, LOG_DEPARTURE - math.log(off)
        s.count, s.started = off, True
        s.spans[[at.SPAN_FORCE, at.SPAN_PRESS]] = LEAST_FORCE * noise

    def take(self, t: float, row: np.ndarray) -> None:
        """One row (12,) in SI units, NaN where missing, at a time after all before.

        Of a wrist's sensor (16,): what `hmmseg.online.wrist.Wrist` adds.
        """
        self.rows.append((t, row))
        while self.rows[0][0] < t - self.lag - REACH:
            self.rows.popleft()
        self._take(t, row)

    def _take(self, t: float, row: np.ndarray) -> None:
        s = self._state
        if not s.started:
            self._wait(t, row)
            return
        dt = t - s.last_t if s.num_rows else 0.0
        s.num_rows += 1
        derived = not self.rig.jointed and not self._velocities
        hand_row(row, self.rig.jointed, self._geometry, not derived, s.last_row, max(dt, 1e-9), self._row)
        if derived and dt == 0.0:
            self._row[4:6] = math.nan
        s.head = (s.head + 1) % ROWS
        s.filled = min(s.filled + 1, ROWS)
        x = self._x
        read(s.history, s.head, s.filled, t, dt, self._row, self._noise, not derived, x)
        widen(s.extremes, s.spans, self._least, x)
        if row.size > NUM_CHANNELS:
            x[at.SD_FX :] = row[NUM_CHANNELS + 1 :]
        s.since += dt
        since = s.since if s.since >= 0.999 / MAX_RATE else 0.0
        if since:
            s.since = 0.0
        share = min(1.0, dt / self.together) if dt > 0 else 1.0
        s.last_t = t
        s.last_row = row
        s.count, _ = advance(
            s.table, s.count, self._fresh, x, dt, since, share, self._chain, self.num_rounds, self.cyclic,
            s.spans, self._pads, self.rig.gravity, self.layout.num_objects, self.layout.rises,
            self.properties.signs,
        )  # fmt: skip
        self._settle(t - self.lag)

    def idle(self, t: float) -> None:
        """Time goes on, though no row can be read yet."""
        self.first_t = t if math.isnan(self.first_t) else self.first_t
        if not self._state.started:
            self._state.last_t = t

    def _wait(self, t: float, row: np.ndarray) -> None:
        """Until the force noise is known: from the rig, or from the first rows' second differences."""
        s = self._state
        if not s.num_rows:
            self.first_t = t if math.isnan(self.first_t) else self.first_t
            self._velocities = self.rig.jointed or not np.isnan(row[[2, 3, 8, 9]]).all()
        self._waiting.append((t, row))
        s.last_t, s.num_rows = t, s.num_rows + 1
        noise = self.force_noise
        if noise is None and len(self._waiting) >= WARM_UP:
            forces = np.array([each[[4, 5, 10, 11]] for _, each in self._waiting])
            found = [noise_sd(column) for column in forces.T]
            noise = max(float(np.nan_to_num(np.nanmedian(found))), 1e-5)
        if noise is None:
            return
        waiting, self._waiting = self._waiting, []
        s.last_t, s.num_rows = waiting[0][0], 0
        self._begin(noise)
        for each_t, each in waiting:
            self._take(each_t, each)

    def _settle(self, before: float) -> None:
        """Boundaries that are now older than the lag, each once."""
        s = self._state
        while self._now[-1] < 0.5:  # off the task nothing is a boundary of it
            mean, variance, come, early = boundary(s.table, s.count, self.num_steps, s.settled, before)
            if early < 0.5 or come <= 0:
                return
            self._settled(s.settled, mean, variance)
            s.settled += 1

    def _settled(self, number: int, mean: float, variance: float) -> None:
        del self.crossings[number:]
        self.crossings.append(self._crossing(number, mean, math.sqrt(variance)))

    def _crossing(self, number: int, mean: float, sd: float) -> Crossing:
        """A boundary from the filter, or from the rows around it where these say it more finely."""
        per_round = self.num_steps - 1
        before, after = (self.steps[(number + k - 1) % per_round + 1 if number + k else 0] for k in (0, 1))
        best = self._state.table[int(self._state.table[: self._state.count, at.WEIGHT].argmax())]
        previous = self.crossings[number - 1].t if number else -math.inf
        found = refined(self, best, before, after, previous, mean, sd)
        return Crossing(after, number // per_round, *(found or (mean, sd)))

    def properties_text(self, answer: Answer) -> str:
        """The properties as JSON, written anew once an independent reading, as they change no faster."""
        if answer.final or not answer.t < self._written_t + 1 / MAX_RATE:
            self._written, self._written_t = answer.properties_json(), answer.t
        return self._written

    @property
    def failed_now(self) -> bool:
        """Whether the recording has more likely than not left its task."""
        return bool(self._now[-1] > 0.5)

    def answer(self, final: bool = False) -> Answer:
        """What is known now."""
        s = self._state
        if not s.started:
            self._now[:], self._smoothed[:] = 0.0, 0.0
            self._now[0] = self._smoothed[0] = 1.0
            self._means[:] = 0.0
            self._best[:] = 0.0
        else:
            summarise(s.table, s.count, self.num_steps, s.last_t - self.lag, self.layout.num_objects,
                      self.layout.num_moves, self.layout.rises, self._now, self._smoothed, self._means,
                      self._best)  # fmt: skip
        return Answer(self, s.last_t, self._now, self._smoothed, self._means, self._best, final)

    def finish(self) -> Answer:
        """The last answer: every boundary that has come is settled, whatever its age."""
        s = self._state
        if not s.started and self._waiting:
            self.force_noise = self.force_noise or 0.01
            t, row = self._waiting.pop()
            s.num_rows -= 1
            self._wait(t, row)
        if s.started:
            self._settle(s.last_t)
        return self.answer(final=True)

    def snapshot(self) -> Any:
        """All that changes, to return to with `restore`."""
        s = self._state
        state = copy.copy(s)
        state.table, state.history = s.table[: s.count].copy(), s.history.copy()
        state.extremes, state.spans = s.extremes.copy(), s.spans.copy()
        return state, len(self.crossings), list(self._waiting), self._now.copy()

    def restore(self, snapshot: Any) -> list[tuple[float, np.ndarray]]:
        """Return to an earlier point; the rows taken since."""
        state, crossings, self._waiting = snapshot[0], snapshot[1], list(snapshot[2])
        table = self._state.table
        table[: state.count] = state.table
        self._state = copy.copy(state)
        self._state.table, self._state.history = table, state.history.copy()
        self._state.extremes, self._state.spans = state.extremes.copy(), state.spans.copy()
        self._now[:] = snapshot[3]
        del self.crossings[crossings:]
        since = [each for each in self.rows if each[0] > state.last_t]
        for _ in since:
            self.rows.pop()
        return since
