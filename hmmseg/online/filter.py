"""The filter of a block task: processes one row after another, without looking ahead beyond the lag.

It filters alignments jointly with the blocks' unknown weights and widths: hypotheses that differ by the start
of each subtask carry conjugate posteriors of everything else (a Rao-Blackwellised filter that enumerates
instead of drawing particles; Adams and MacKay 2007; Doucet et al. 2000). docs/watch.md.

The filter resolves a boundary to one of its samples. Where a block is lifted, or samples are sparse, the
contact equations refine it: the two subtasks are aligned alone, with the crossing between samples
(hmmseg.segmentation.boundaries), under the parameters learned by the filter.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmmseg.contact.decompose import (
    ABOVE_GROUND,
    FREE,
    ON_GROUND,
    SLIDING,
    Subtask,
    height_equations,
    subtasks,
)
from hmmseg.contact.equations import pads_of
from hmmseg.hand.signals import task_space
from hmmseg.hmm import left_to_right, smooth
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import CARTESIAN_CHANNELS, CARTESIAN_OPTIONAL, JOINT_CHANNELS, Trial
from hmmseg.levels import DRIFTS
from hmmseg.online.answer import Answer, Crossing
from hmmseg.online.hypotheses import LOG_DEPARTURE, advance, boundary, summarise
from hmmseg.online.hypothesis import (
    ABOVE_KIND,
    FREE_KIND,
    GROUND_KIND,
    HYPOTHESIS,
    RANGES,
    READING,
    ROW,
    ROWS,
    SCALES,
    SLIDING_KIND,
    read,
    widen,
)
from hmmseg.segmentation.boundaries import evenly, normal
from hmmseg.segmentation.changes import Prior, moment
from hmmseg.segmentation.emissions import (
    MAX_RATE,
    WINDOW,
    Parameters,
    features,
    log_likelihoods,
    noise_sd,
    thin,
)
from hmmseg.segmentation.pads import sense
from hmmseg.segmentation.posteriors import contacts, nearest_touch
from hmmseg.segmentation.rounds import one_round, round_tasks

WARM_UP = 8  # numerics: rows from which a force noise that the rig does not state is estimated
NUM_CHANNELS = len(CARTESIAN_CHANNELS)
KINDS = {FREE: FREE_KIND, ON_GROUND: GROUND_KIND, SLIDING: SLIDING_KIND, ABOVE_GROUND: ABOVE_KIND}
# chosen: initial scales [m/s, m, m]: a hand at rest creeps, and pads' foam gives by tenths of a mm
VELOCITY, LEVEL, WIDTH = 5e-3, 2e-4, 2e-4
PRIOR = 4.0  # prior: readings that an initial scale is worth
# prior: ranges of a hand before it has moved: vx, vy [m/s], y, d [m]; worth a few nats at most
LEAST_SPANS = (0.1, 0.1, 0.03, 0.03)
LEAST_FORCE = 50.0  # prior: initial range of its forces, in sds of their noise
ROUGH = 3.0  # prior: initial scale of a held block's net and shear force, in sds of the force noise
UNBIASED = 10.0  # prior: initial sd of a sensor's bias, in sds of its noise
NEAREST = round(DRIFTS * MAX_RATE)  # samples of a hold that locate the block next to a contact change
REACH = 0.6  # chosen: s of the subtask before a boundary that refine it
FINE = 100.0  # numerics: Hz; in faster recordings the filter itself places touches


@dataclass
class _State:
    """Everything that changes from row to row; a copy is a point to return to."""

    rows: np.ndarray
    known: np.ndarray
    count: int
    ring: np.ndarray
    extremes: np.ndarray
    ranges: np.ndarray
    last_row: np.ndarray
    head: int = -1
    filled: int = 0
    last_t: float = math.nan
    since: float = 0.0
    settled: int = 0
    started: bool = False
    num_rows: int = 0


class Filter:
    """Follows one performance of a block task, given its rows in order of time (see Watcher)."""

    def __init__(self, task: BlockTask, rig: Rig, lag: float) -> None:
        self.task, self.rig, self.lag = task, rig, lag
        self.channels = JOINT_CHANNELS if rig.jointed else CARTESIAN_CHANNELS
        self.optional = () if rig.jointed else CARTESIAN_OPTIONAL
        self.rows: deque[tuple[float, np.ndarray]] = deque()  # of the last lag + REACH seconds
        self._prepare_task(task)
        noise = rig.noise
        position = noise.angle if rig.jointed else noise.position
        fingers = [rig.finger(i) for i in (1, 2)] if rig.jointed else []
        self._geometry = np.array([v for f in fingers for v in (*f.base, *f.links)] or [0.0] * 8)
        self._noise = np.array([(position or 0.0) ** 2, (noise.velocity or 0.0) ** 2])
        self._pads, self.force_noise = np.array(pads_of(rig), float), noise.force
        self._written, self._written_t = "{}", -math.inf
        self.crossings: list[Crossing] = []
        self.first_t = math.nan  # of the first row [s]
        self.touches: list[tuple[float, float]] = []  # times and sds of touches known apart from forces [s]
        self.together = 1.0 / MAX_RATE  # readings closer than this are not independent [s]
        self._waiting: list[tuple[float, np.ndarray]] = []
        self._velocities = True
        num_quantities = 2 * (len(task.objects) + 1) + len(task.moves)
        num_states = len(self._chain[0])
        self._fresh, self._table = (
            (np.zeros(most, HYPOTHESIS), np.zeros((most, num_quantities, 2)))
            for most in (num_states + 2, 24 * num_states)
        )
        self._x = np.full(1, np.nan).astype(READING)
        self._x["sd_fx"], self._x["sd_fy"], self._x["gripped"] = 0.0, 0.0, 1.0
        # As `summarise` fills them.
        self.now: np.ndarray = np.zeros(self.num_steps + 1)
        self.smoothed: np.ndarray = np.zeros(self.num_steps + 1)
        self.means = np.zeros((2 * len(task.objects) + len(task.moves), 3))
        # The heaviest hypotheses: round of the one on the task; missed subtask, time [s] and state off it.
        self._least = np.array(LEAST_SPANS)
        self.round: int = 0
        self.departure: tuple[int, float, int] = 0, 0.0, 0
        self._state = _State(
            *self._table, 0, np.full(ROWS, np.nan).astype(ROW), np.array([[np.inf, -np.inf]] * 4),
            np.array([(*LEAST_SPANS, 1.0, 1.0)], RANGES), np.zeros(12),
        )  # fmt: skip

    def _prepare_task(self, task: BlockTask) -> None:
        self.steps: tuple[Subtask, ...] = subtasks(one_round(task))
        self.num_steps = len(self.steps)
        names = list(task.objects)
        sliding = any(move.slide for move in task.moves)
        states = (ON_GROUND, ABOVE_GROUND, SLIDING) if sliding else (ON_GROUND, ABOVE_GROUND)
        off = [(FREE, -1), *((state, o) for o in range(len(names) + 1) for state in states)]
        own = [(s.state, -1 if s.state == FREE else names.index(str(s.object))) for s in self.steps]
        self.off_task = [(state, None if o < 0 else [*names, None][o]) for state, o in off]
        repeats = 1000 if task.repeat == "unknown" else task.repeat
        self.num_rounds, self.cyclic = repeats, repeats > 1
        self.properties = Properties(task, round_tasks(task, min(repeats, 2 * len(names) + 2)), self.rig)
        steady = self.properties.steady
        moves = [-1 if s.move is None or not steady[s.move] else s.move for s in self.steps]
        states = [(KINDS[state], o, move)
                  for (state, o), move in zip(own + off, moves + [-1] * len(off), strict=True)]  # fmt: skip
        self._chain = np.array(states), self.properties.signs, self.num_steps, len(names), repeats

    def _begin(self, noise: float) -> None:
        """Create the initial hypothesis, and those of a recording that starts off its task."""
        s = self._state
        h = np.zeros(1, HYPOTHESIS)
        h["missed"], h["left_at"], h["entered"][:, 0] = -1, math.inf, s.last_t
        h["bias"][..., 1] = (
            1.0 / np.maximum(UNBIASED * noise, 3 * np.array(self.rig.systematic.force_bias)) ** 2
        )
        rough = ROUGH * noise
        starts = np.array([noise, rough, rough, rough, VELOCITY, LEVEL, WIDTH])
        h["scale"][0] = np.stack([PRIOR * starts**2, np.full(starts.size, PRIOR)], axis=1)
        off = len(self.off_task)
        s.rows[:off], s.known[:off] = h, 0.0
        away = s.rows[1:off]  # initial free motion always belongs to the task
        away["state"], away["missed"] = self.num_steps + np.arange(1, off), 0
        away["left_at"], away["weight"] = s.last_t, LOG_DEPARTURE - math.log(off)
        s.count, s.started = off, True
        s.ranges["force"] = s.ranges["press"] = LEAST_FORCE * noise

    def take(self, t: float, row: np.ndarray) -> None:
        """Process one row (12,) in SI units, NaN where missing, later than all before.

        For a wrist's sensor (16,), with what `hmmseg.online.wrist.Wrist` adds.
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
        s.head = (s.head + 1) % ROWS
        s.filled = min(s.filled + 1, ROWS)
        x, jointed = self._x, self.rig.jointed
        read(s.ring, s.head, s.filled, t, dt, row, jointed, self._geometry, jointed or self._velocities,
             s.last_row, self._noise, x)  # fmt: skip
        widen(s.extremes, s.ranges, self._least, x)
        if row.size > NUM_CHANNELS:
            x["sd_fx"], x["sd_fy"], x["gripped"] = row[NUM_CHANNELS + 1 :]
        s.since += dt
        since = s.since if s.since >= 0.999 / MAX_RATE else 0.0
        if since:
            s.since = 0.0
        share = min(1.0, dt / self.together) if dt > 0 else 1.0
        s.last_t, s.last_row = t, row
        s.count = advance(*self._table, *self._fresh, s.count, x, dt, since, share, *self._chain, s.ranges,
                          self._pads, self.rig.gravity)  # fmt: skip
        self._settle(t - self.lag)

    def idle(self, t: float) -> None:
        """Advance the time while no row can be read yet."""
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
        """Settle boundaries that are now older than the lag, each once."""
        s = self._state
        while self.now[-1] < 0.5:  # nothing off the task is a boundary of it
            mean, variance, come, early = boundary(s.rows, s.count, self.num_steps, s.settled, before)
            if early < 0.5 or come <= 0:
                return
            number, per_round, sd = s.settled, self.num_steps - 1, math.sqrt(variance)
            del self.crossings[number:]
            ended, begun = (self.steps[(n - 1) % per_round + 1 if n else 0] for n in (number, number + 1))
            previous = self.crossings[-1].t if number else -math.inf
            refined = self._refined(ended, begun, previous, mean, sd)
            self.crossings.append(Crossing(begun, number // per_round, *(refined or (mean, sd))))
            s.settled += 1

    def _refined(
        self, before: Subtask, after: Subtask, previous: float, mean: float, sd: float
    ) -> tuple[float, float] | None:
        """Refine a boundary that the filter places at `mean`: median and sd [s]; None if the rows cannot.

        `previous` [s]: the boundary before.
        """
        if self.rig.gripper is not None and FREE in (before.state, after.state):
            boundary_posterior = nearest_touch(tuple(self.touches), normal(mean, sd))
            return boundary_posterior.quantile(0.5), boundary_posterior.sd
        touch = before.state == FREE or after.name == "place"
        start = max(mean - REACH, previous)
        rows = [each for each in self.rows if start <= each[0] <= mean + max(self.lag, REACH)]
        if len(rows) < 2 * NEAREST or self.now[-1] > 0.5:
            return None
        t = np.array([each[0] for each in rows])
        if touch and 1.0 / np.median(np.diff(t)) > FINE:
            return None
        table = np.array([each[1] for each in rows])
        recorded = {name: c for name, c in zip(self.channels, table.T, strict=False) if not np.isnan(c).all()}
        if set(self.channels) - set(recorded) - set(self.optional):
            return None
        timing = table[:, NUM_CHANNELS] if self.rig.gripper is not None else None
        trial = Trial("stream", t, recorded, timing=timing)
        signals = thin(task_space(trial, self.rig), MAX_RATE, WINDOW)
        if signals.t.size < NEAREST:
            return None
        parameters, f = self._parameters(), features(signals, self.rig)
        steps = (replace(before, index=0), replace(after, index=1))
        levels, height = {}, f.block_y(parameters.bias)
        for step, near in zip(
            steps, (height[f.t < mean][-NEAREST:], height[f.t > mean][:NEAREST]), strict=True
        ):
            if step.state in (ON_GROUND, SLIDING) and np.isfinite(near).any():
                levels[step.index] = float(np.nanmedian(near))
        parameters = replace(parameters, levels=(levels,))
        chain = left_to_right([signals.t.size / 2] * 2)
        try:
            posterior = smooth(log_likelihoods(f, steps, parameters, 0), chain)
        except ValueError:
            return None
        probability = posterior.boundary[:, 0]
        n, t = int(probability.argmax()), signals.t
        near = (t[n + 1], t[n + 1] + DRIFTS) if touch else (t[n] - DRIFTS, t[n])
        contact = contacts(signals, sense([], [], (), parameters, self.rig), parameters)
        change = contact.change(*steps, Prior(t, probability, (float(t[0]), float(t[-1]))), near)
        out = evenly(t, probability) if change is None else moment(change)
        median = out.quantile(0.5)
        if not math.isfinite(median) or abs(median - mean) > 3 * sd + 2 / MAX_RATE:
            return None  # not the filter's event
        return median, out.sd

    def _parameters(self) -> Parameters:
        """Parameters learned by the heaviest hypothesis, named as in hmmseg.segmentation.emissions."""
        s = self._state
        best = int(s.rows["weight"][: s.count].argmax())
        h, known = s.rows[best], s.known[best]
        sds = np.sqrt(h["scale"][:, 0] / h["scale"][:, 1]).tolist()
        scale: dict[str, float] = dict(zip(SCALES, sds, strict=True))
        weight, width = {}, {}
        for o, name in enumerate(self.task.objects):
            (load, sure), (size, seen) = known[2 * o : 2 * o + 2].tolist()
            weight[name] = max(load / sure, 1e-3) if sure > 0 else 10 * scale["force"]
            if seen > 0:
                width[name] = size / seen
        return Parameters(h["bias"][:, 0] / h["bias"][:, 1], weight, scale, width)

    def properties_text(self, answer: Answer) -> str:
        """The properties as JSON, rewritten once per independent reading, as they change no faster."""
        if answer.final or not answer.t < self._written_t + 1 / MAX_RATE:
            self._written, self._written_t = answer.properties_json(), answer.t
        return self._written

    def answer(self, final: bool = False) -> Answer:
        """The current answer."""
        s = self._state
        if not s.started:
            self.now[:], self.smoothed[:], self.means[:] = 0.0, 0.0, 0.0
            self.now[0] = self.smoothed[0] = 1.0
        else:
            blocks, before = len(self.task.objects), s.last_t - self.lag
            on, off = summarise(s.rows, s.known, s.count, self.num_steps, blocks, before, self.now,
                                self.smoothed, self.means)  # fmt: skip
            if on >= 0:
                self.round = int(s.rows["round"][on])
            if off >= 0:
                missed, left_at, state = (s.rows[name][off].item() for name in ("missed", "left_at", "state"))
                self.departure = missed, left_at, state - self.num_steps
        return Answer(self, s.last_t, final)

    def finish(self) -> Answer:
        """The final answer, with all boundaries settled whatever their age."""
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
        """Everything that changes, for `restore`."""
        s = self._state
        # Structured arrays are slow to copy.
        big = s.rows[: s.count].tobytes(), s.known[: s.count].copy(), s.ring.tobytes()
        small = copy.copy(s), s.extremes.copy(), s.ranges.copy()
        return small, big, len(self.crossings), list(self._waiting), self.now.copy()

    def restore(self, snapshot: Any) -> list[tuple[float, np.ndarray]]:
        """Return to an earlier point; returns the rows taken since."""
        (state, extremes, ranges), (rows, known, ring), crossings, waiting, now = snapshot
        self._state = s = copy.copy(state)
        s.rows[: s.count], s.known[: s.count] = np.frombuffer(rows, HYPOTHESIS), known
        s.ring, s.extremes, s.ranges = np.frombuffer(ring, ROW).copy(), extremes.copy(), ranges.copy()
        self._waiting, self.now[:] = list(waiting), now
        del self.crossings[crossings:]
        since = [each for each in self.rows if each[0] > state.last_t]
        for _ in since:
            self.rows.pop()
        return since


class Properties:
    """Properties of every block from the means of weights, widths and rises, with errors common to all rows.

    `steady` (num_moves,): whether a move has the same height equation in every round; `signs` (num_moves,):
    direction of its rise where known, otherwise 0.
    """

    def __init__(self, task: BlockTask, rounds: Sequence[BlockTask], rig: Rig) -> None:
        self.objects = task.objects
        each = [height_equations(one_round(one)) for one in rounds]
        self.steady = [len({str(sorted(e[m][1].items())) for e in each}) == 1 for m in range(len(task.moves))]
        self.equations = np.zeros((len(task.moves), len(task.objects)))
        self.signs = np.zeros(len(task.moves))
        for move, rise in each[0]:
            if self.steady[move] and rise and not task.moves[move].slide:
                for name, coefficient in rise.items():
                    self.equations[move, task.objects.index(name)] = coefficient
                if len({np.sign(v) for v in rise.values()}) == 1:
                    self.signs[move] = np.sign(next(iter(rise.values())))
        gain = np.array(rig.systematic.force_gain)
        self.weight_gain = float(np.hypot(gain[1], gain[3]) / 2)  # half of it on each finger
        self.touch_sd = 0.0  # common error of all grips in the distance at which fingers touch [m]
        self.force_sd = 0.0  # common error of all grips in the zero of the net force [N]
        self._seen: bytes = b""
        self._heights: list[tuple[str, str, float, float]] = []

    def table(self, means: np.ndarray) -> list[tuple[str, str, float, float]]:
        """(object, property, mean, sd) of the properties that are known with a probability above 0.5."""
        out = []
        for o, name in enumerate(self.objects):
            (weight, of_weight, weighed), (width, of_width, seen) = means[2 * o : 2 * o + 2].tolist()
            if weighed > 0.5:
                variance = of_weight + (self.weight_gain * weight) ** 2 + self.force_sd**2
                out.append((name, "weight", weight, math.sqrt(variance)))
            if seen > 0.5:
                out.append((name, "width", width, math.sqrt(of_width + self.touch_sd**2)))
        rises = means[2 * len(self.objects) :]
        if rises.size and rises[:, 2].max() > 0.5:
            key = rises.tobytes()
            if key != self._seen:
                self._seen, self._heights = key, self._solve(rises)
            out += self._heights
        return out

    def _solve(self, rises: np.ndarray) -> list[tuple[str, str, float, float]]:
        """Heights that the rises determine, by weighted least squares."""
        used = (rises[:, 2] > 0.5) & (self.equations != 0).any(axis=1)
        if not used.any():
            return []
        a = self.equations[used] / np.sqrt(rises[used, 1])[:, None]
        inverse = np.linalg.pinv(a.T @ a)
        mean = inverse @ a.T @ (rises[used, 0] / np.sqrt(rises[used, 1]))
        determined = np.abs(np.linalg.pinv(a) @ a - np.eye(len(self.objects))).max(axis=1) < 1e-9
        sd = np.sqrt(np.diag(inverse))
        return [(name, "height", float(mean[o]), float(sd[o]))
                for o, name in enumerate(self.objects) if determined[o]]  # fmt: skip
