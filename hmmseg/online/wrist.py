"""Rows of a gripper with a sensor in its wrist as the two fingers that a filter follows.

As `hmmseg.hand.wrist`, from the rows so far. What the tool itself puts on the sensor is found from
the free motion before the first grip, so nothing can be said before that (all of it is the task's first
subtask anyhow), and anew at every further one. Motion is smoothed over a window, so rows come out a window
late; while the gripper closes or lets go, until it is known when it touched.

Off line a closing is read from both of its ends (`hmmseg.hand.wrist`). While it happens, a touch shows only
once the gripper stands, some tens of milliseconds after it; until then nobody knows whether samples since
it slowed down were of a grip. Those are held back.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.tool import WINDOW, FreeMotion, Pose, Tool, applied_force, free_motion, pose_of, tool_of
from hmmseg.hand.wrist import (
    LEAST_CLOSING,
    REST,
    SLOWED,
    STEP,
    TOGETHER,
    Grip,
    as_fingers,
    give_of,
    grip_force_of,
    grip_of,
    other_sign,
)
from hmmseg.io.rig import Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, Trial
from hmmseg.levels import MOVED, SURE
from hmmseg.robust import bridged, robust_sd, white_sd

WHERE = "stream"
BATCH = 0.02  # numerics: s that are turned into fingers together
BACKLOG = 10.0  # numerics: s before the first grip that are kept for the filter
FREE = 1200  # numerics: samples of free motion that the tool is found from, ...
APART = 8  # numerics: ... so many of them in a window
KEPT = 30.0  # chosen: s for which a grip may turn out to be none
AROUND = 4  # numerics: windows kept before what is smoothed: it is then as in the whole recording
TOUCHES = 8  # numerics: touches kept: a boundary looks back over fewer


class Wrist:
    """Takes rows of `rig.gripper.channels` at times in s; gives rows of a Cartesian hand.

    A row that comes out has 16 numbers: the Cartesian channels, how uncertain a change of force is in time
    [s], by how much the tool's own share may be wrong, across and up [N], and 0 where nothing is held, 2
    where something is, 1 close to a touch. `touch_sd` [m], `touches` [s, s]: as in `Trial`.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig, self.gripper, self.names = rig, rig.wrist, rig.wrist.channels
        self._rows: list[tuple[float, tuple[float, ...]]] = []  # in order of time, a window's context
        self._out = -math.inf  # up to where rows have come out
        self._opening = Closings(self._gives)
        self._last_opening = [math.nan] * len(self.gripper.opening)
        self._window: float | None = None
        self._free: deque[FreeMotion] = deque()
        self._num_free, self._free_until = 0, -math.inf
        self._fitted = 0  # grips before which the tool was found
        self.tool: Tool | None = None
        self.touches: list[tuple[float, float]] = []
        self.mark: float | None = None  # start of a new grip, which has not come out yet [s]
        self.back = False  # the last grip was none: what has come out since it began comes again
        self._went = Went()

        self.force_sd = 0.0  # by how much a drift that free motion did not show may be wrong in a grip [N]

    @property
    def touch_sd(self) -> float:
        """How well the openings at which pads touched are known [m]."""
        sds = [each.grip.width_sd for each in self._opening.grips]
        return float(np.sqrt(np.mean(np.square(sds)))) if sds else 0.0

    @property
    def newest(self) -> float:
        """Time of the newest row [s], NaN before the first."""
        return self._rows[-1][0] if self._rows else math.nan

    @property
    def delay(self) -> float:
        """How much later than rows come in they come out [s], while the gripper stands or is open."""
        return self._window or WINDOW

    def place(self, t: float, row: np.ndarray) -> str | None:
        """Put a row in its place; what is irregular about that, in a word."""
        if self._rows and t <= self._rows[-1][0]:
            same = next((old for at, old in reversed(self._rows) if at == t), None)
            if same is not None:
                return "repeated" if np.array_equal(same, row, equal_nan=True) else "contradictory"
            if t <= self._out:
                return "too late"
            insort(self._rows, (t, tuple(row)), key=lambda each: each[0])
            return "late"
        self._rows.append((t, tuple(row)))
        where = [self.names.index(name) for name in self.gripper.opening]
        for i, at in enumerate(where):
            if math.isfinite(row[at]):
                self._last_opening[i] = row[at]
        opening = sum(self._last_opening)
        if math.isfinite(opening):
            self._opening.take(t, opening)
        return None

    def ready(self, final: bool = False) -> list[tuple[float, np.ndarray]]:
        """Rows that are ready now, each once; with `final` all that are left."""
        if not self._rows:
            return []
        newest = self.newest
        if self.tool is None and not (self._opening.number or final):
            if self._rows[0][0] < newest - BACKLOG:  # older free motion is kept as what it says of the tool
                self._gather(newest - BACKLOG / 2)
                self._rows = [each for each in self._rows if each[0] >= newest - BACKLOG / 2]
            return []
        until = newest if final else min(newest - (self._window or 0.0), self._opening.known)
        if not final and until < self._out + BATCH and self._fitted == self._opening.number:
            return []
        self._return()
        return self._turned(until)

    def _return(self) -> None:
        """Go back to where a grip began that was none."""
        refused, self._opening.refused = self._opening.refused, None
        if refused is None or not self._rows or refused.start <= self._rows[0][0]:
            return
        if refused.start <= self._out:
            self.back = True
            self._out = max(t for t, _ in self._rows if t < refused.start)
            self.touches = [touch for touch in self.touches if touch[0] <= self._out]
        self._free_until = min(self._free_until, self._out)
        self._went = Went()

    def _trial(self, rows: list[tuple[float, tuple[float, ...]]]) -> Trial:
        values = np.array([row for _, row in rows])
        return Trial(WHERE, np.array([t for t, _ in rows]),
                     {name: values[:, i] for i, name in enumerate(self.names)})  # fmt: skip

    def _there(self, trial: Trial) -> bool:
        """Whether every channel has a value to smooth."""
        return trial.t.size > 3 and all(np.isfinite(c).any() for c in trial.channels.values())

    def _opened(self, trial: Trial) -> np.ndarray:
        """Opening (num_timesteps,) [m], gaps bridged."""
        return np.sum([bridged(trial.channels[name], trial.t) for name in self.gripper.opening], axis=0)

    def _gather(self, until: float) -> None:
        """Add free motion up to `until` to what the tool is found from."""
        trial = self._trial(self._rows)
        if not self._there(trial):
            return
        pose = pose_of(trial, self.gripper, self._window)
        self._window = pose.window
        opening = self._opened(trial)
        free = self._opening.free(trial.t, opening) & (trial.t > self._free_until) & (trial.t <= until)
        step = max(1, round(self._window / APART / float(np.median(np.diff(trial.t)))))
        picked = np.flatnonzero(free)[::step]
        self._free_until = max(self._free_until, min(until, float(trial.t[-1])))
        if picked.size == 0:
            return
        mask = np.zeros(trial.t.size, bool)
        mask[picked] = True
        found = free_motion(trial, self.rig, pose, mask)
        self._free.append(found)
        self._num_free += found.t.size
        while self._num_free - self._free[0].t.size > FREE:
            self._num_free -= self._free.popleft().t.size

    def _find_tool(self) -> None:
        self._fitted = self._opening.number
        parts = [FreeMotion(np.zeros(0), np.zeros((0, 3)), np.zeros((4, 0, 3)), 0.0), *self._free]
        motion = FreeMotion(
            np.concatenate([p.t for p in parts]), np.concatenate([p.force for p in parts]),
            np.concatenate([p.terms for p in parts], axis=1), self._window or 0.0,
        )  # fmt: skip
        if self.tool is not None and motion.t.size < 1:
            return
        since = float(motion.t.mean()) if motion.t.size else 0.0
        self.tool = tool_of(WHERE, self.rig, motion, since, between=self._fitted > 1)

    def _turned(self, until: float) -> list[tuple[float, np.ndarray]]:
        first = self.tool is None
        self._gather(until)
        if first or self._fitted != self._opening.number:
            self._find_tool()
            held = self._opening.held
            self.mark = None if held is None else held.start
        tool, window = self.tool, self._window
        assert tool is not None and window is not None
        trial = self._trial(self._rows)
        out = [] if not self._there(trial) else self._as_rows(trial, tool, until)
        if not out:
            out = [(t, np.full(16, np.nan)) for t, _ in self._rows if self._out < t <= until]
        self._out = max(self._out, until)
        keep, held = self._out, self._opening.held or self._opening.refused
        if held is not None and held.start > self._out - KEPT:
            keep = min(keep, held.start)
        keep -= AROUND * window
        self._rows = [each for each in self._rows if each[0] > keep]
        return out

    def _as_rows(self, trial: Trial, tool: Tool, until: float) -> list[tuple[float, np.ndarray]]:
        pose = pose_of(trial, self.gripper, self._window)
        force, near, grips = applied_force(trial, self.rig, pose, tool), np.zeros(trial.t.size), []
        for held in self._opening.grips:
            start, stop = np.searchsorted(trial.t, [held.start, held.stop]).tolist()
            if stop > start:
                grips.append(replace(held.grip, start=start, stop=stop))
                near[max(start - 1, 0) : stop + 1] = 1.0
        for each in grips:
            near[each.start + 1 : each.stop - 1] = 2.0
        found = as_fingers(trial, self.rig, pose, tool, self._opened(trial), force, grips,
                           grip_force_of(trial, self.gripper))  # fmt: skip
        self._decide(trial, pose, force, tool, until)
        if self._opening.held is not None:
            self.force_sd = max(self.force_sd, tool.drift_sd * abs(until - tool.since))
        self.touches += [touch for touch in found.touches if self._out < touch[0] <= until]
        del self.touches[:-TOUCHES]
        assert found.timing is not None and found.inertia is not None
        table = np.stack(
            [*(found.channels[name] for name in CARTESIAN_CHANNELS), found.timing, *found.inertia.T, near],
            axis=1,
        )
        table[np.isnan(np.stack(list(trial.channels.values()))).all(axis=0)] = np.nan
        chosen = np.flatnonzero((trial.t > self._out) & (trial.t <= until))
        return [(float(trial.t[i]), table[i]) for i in chosen]

    def _decide(self, trial: Trial, pose: Pose, force: np.ndarray, tool: Tool, until: float) -> None:
        """Whether the hand bears anything once it goes somewhere; InputError where that pulls up."""
        held = self._opening.held
        if held is None or held.start > until:
            self._went = Went()
            return
        new = np.flatnonzero((trial.t > max(self._out, held.start)) & (trial.t <= until))
        height, up, across = pose.position @ pose.up, force @ pose.up, force @ pose.across
        for i in new[np.isfinite(force[new]).all(axis=1)]:
            self._went.take(float(trial.t[i]), float(height[i]), pose.position[i], float(up[i]),
                            float(across[i]), pose.window / TOGETHER)  # fmt: skip
        load = self._went.load(tool.noise)
        if load is None:
            return
        if load < 0:
            raise other_sign(trial, self.rig, load)
        if load == 0.0:
            self._opening.refuse()

    def _gives(self, t: np.ndarray, opening: np.ndarray) -> float | None:
        """What the pads give in a closing that ends now [m]."""
        rows = [each for each in self._rows if each[0] >= t[0]]
        if not rows:
            return None
        trial, last = self._trial(rows), len(rows) - 1
        way = np.interp(trial.t, t, opening)
        return give_of(self.rig, grip_force_of(trial, self.gripper), way, (0, last, last))


def checked(rig: Rig, t: float, row: np.ndarray) -> None:
    """InputError for a row's orientation that cannot be, which a stream tells by its time."""
    gripper = rig.gripper
    if gripper is None or gripper.quaternion is None:
        return
    q = [row[gripper.channels.index(name)] for name in gripper.quaternion]
    norm = math.sqrt(sum(value * value for value in q))
    if math.isfinite(norm) and not abs(norm - 1) < 0.05:
        where = f"{WHERE}: t = {t:.9g} s: columns {', '.join(gripper.quaternion)}"
        raise InputError(where, f"a quaternion of norm {norm:.3g}", "a norm of 1 (x, y, z, w)")


STAND = 0.1  # chosen: s of next to no motion: the gripper stands
SAMPLES = 4  # numerics: of a stand at least, and steps: what the touch is read from
PATIENCE = 1.0  # chosen: s that samples are held back at most, as long as a boundary is waited for
NOISE = 200  # numerics: samples that determine the opening's noise
REMEMBERED = 10.0  # numerics: s of a closing that are kept


@dataclass
class Held:
    """One grip: from `start` to `stop` [s], inf while it lasts; `grip` as off line."""

    start: float
    grip: Grip
    stop: float = math.inf


class Closings:
    """Follows an opening, sample by sample.

    `grips`: the last two. `known` [s]: up to when it is known what is held. `give` says of a closing's
    times what the pads give in it [m], None where nothing tells.
    """

    def __init__(self, give: Callable[[np.ndarray, np.ndarray], float | None]) -> None:
        self._give = give
        self.grips: deque[Held] = deque(maxlen=2)
        self.known = -math.inf
        self.closing, self.number = False, 0  # whether it closes now, and how many grips there were
        self.refused: Held | None = None  # the last one, where it was no grip
        self._kept: deque[tuple[float, float]] = deque()  # since the widest opening before
        self._low, self._high = math.inf, -math.inf
        self._noise, self._seen = 0.0, 0
        self._recent: deque[float] = deque(maxlen=NOISE // 10)
        self._fastest, self._slowed, self._floor, self._wide = 0.0, -math.inf, math.inf, math.nan

    @property
    def held(self) -> Held | None:
        """The grip that lasts."""
        return self.grips[-1] if self.grips and self.grips[-1].stop == math.inf else None

    @property
    def swing(self) -> float:
        """Least motion of the opening that counts [m]."""
        return max(REST * (self._high - self._low), 2 * SURE * self._noise, LEAST_CLOSING)

    def free(self, t: np.ndarray, opening: np.ndarray) -> np.ndarray:
        """Which samples are surely of free motion: outside of every grip, more open than halfway."""
        free = t <= self.known
        for held in self.grips:
            free &= (t < held.start) | ((t >= held.stop) & (opening >= (held.grip.held + self._high) / 2))
        return free

    def take(self, t: float, opening: float) -> None:
        """The next sample."""
        self._recent.append(opening)
        if self._seen < NOISE and len(self._recent) == NOISE // 10:
            self._seen += NOISE // 10
            self._noise = max(self._noise, white_sd(np.array(self._recent)))
            self._recent.clear()
        self._low, self._high = min(self._low, opening), max(self._high, opening)
        if not (self.held or self.closing or (self._kept and opening < self._kept[0][1])):
            self._kept.clear()
        self._kept.append((t, opening))
        while t - self._kept[0][0] > REMEMBERED:
            self._kept.popleft()
        if self.held is not None:
            self._hold(t, opening)
        elif self.closing:
            self._close(t, opening)
        else:
            self.known = t
            if opening < self._kept[0][1] - self.swing:
                self.closing, self._fastest, self._slowed, self._floor = True, 0.0, t, opening

    def _speed(self, over: float) -> float:
        """Closing speed over the last `over` s [m/s]."""
        t, opening = self._kept[-1]
        for then, before in reversed(self._kept):
            if t - then >= over - 1e-9:
                return (before - opening) / (t - then)
        return math.nan

    def _close(self, t: float, opening: float) -> None:
        self._floor = min(self._floor, opening)
        if opening > self._floor + self.swing:  # it opens again and has gripped nothing
            self._open(t, opening)
            return
        fast = self._speed(STEP)
        if fast >= SLOWED * self._fastest:
            self._slowed = t
        self._fastest = max(self._fastest, fast)
        self.known = max(self._slowed, t - PATIENCE)
        if t - self._slowed < STAND or not self._speed(STAND) < REST * self._fastest:
            return
        times, way = np.array(self._kept).T
        end = times.size - 1
        stands = end - int(np.argmax(way <= way[end] + REST * (way[0] - way[end])))
        if stands < max(SAMPLES, int(SAMPLES * STEP / float(np.median(np.diff(times))))):
            return
        grip = grip_of(times, way, np.zeros(times.size, bool), (0, end, end), self._give(times, way))
        if grip is None:
            self._open(t, opening)
            return
        self.grips.append(Held(max(float(times[grip.start]), self.known), grip))
        self.refused = None
        self.closing, self.known, self._wide = False, t, math.nan
        self.number += 1

    def _hold(self, t: float, opening: float) -> None:
        held = self.grips[-1]
        self._floor = min(self._floor, opening)
        if opening < held.grip.held - self.swing:  # it had only paused
            self.refused = self.grips.pop()
            self.closing, self._slowed, self.known = True, t, held.start
            return
        if opening <= held.grip.width:
            self._wide, self.known = math.nan, t
            return
        if math.isnan(self._wide):
            self._wide = t
        self.known = max(self.known, t - PATIENCE)
        if opening > max(held.grip.width, self._floor + REST * (self._high - self._floor)):
            held.stop = self._wide
            self._open(t, opening)

    def refuse(self) -> None:
        """The grip that lasts turns out to hold nothing."""
        self.refused = self.grips.pop()
        self._open(*self._kept[-1])

    def _open(self, t: float, opening: float) -> None:
        self.closing, self.known = False, t
        self._floor = math.inf
        self._kept.clear()
        self._kept.append((t, opening))


WENT = 20  # numerics: samples of a hand that goes somewhere before what it bears is judged


class Went:
    """What a hand that holds on to something bears once it has gone somewhere."""

    def __init__(self) -> None:
        self._start: tuple[float, np.ndarray] | None = None
        self._last, self._decided = -math.inf, False
        self._up: list[float] = []
        self._across: list[float] = []
        self._raised = 0

    def take(self, t: float, height: float, position: np.ndarray, up: float, across: float, apart: float
             ) -> None:  # fmt: skip
        """One sample: where it is and what it does to the world; nearer than `apart` [s] they count once."""
        if self._start is None:
            self._start = height, position
        if self._decided or t < self._last + apart:
            return
        raised = height > self._start[0] + MOVED
        if raised or np.linalg.norm(position - self._start[1]) > MOVED:
            self._last = t
            self._up.append(up)
            self._across.append(across)
            self._raised += raised

    def load(self, noise: float) -> float | None:
        """The load [N], 0 for nothing, below 0 for one that pulls up; None before or after it is judged."""
        n = len(self._up)
        if self._decided or n < WENT:
            return None
        self._decided = True
        limit = SURE / math.sqrt(n / TOGETHER)
        up, across = np.array(self._up), np.array(self._across)
        found, aside = float(np.median(up)), float(np.median(across))
        scatter = [max(robust_sd(v - np.median(v)), noise) for v in (up, across)]
        if 2 * self._raised > n and abs(found) > limit * scatter[0]:
            return found
        return 1.0 if abs(aside) > limit * scatter[1] or abs(found) > limit * scatter[0] else 0.0
