"""Rows of a gripper with a sensor in its wrist, converted to the two fingers that a filter follows.

Causal version of `hmmseg.hand.wrist`. The tool's own load on the sensor is identified from the free motion
before the first grip, so there is no output before that (all of it is the task's first subtask anyhow), and
again at every further grip. Motion is smoothed over a window, so rows come out a window late; while the
gripper closes or lets go, they wait until the touch is known, which shows only once the gripper stands.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.grips import LEAST_CLOSING, REST, Closings, Grip, grip_of, least_swing
from hmmseg.hand.tool import WINDOW, Pose, Tool, applied_force, free_motion, pose_of, tool_of
from hmmseg.hand.wrist import as_fingers, bears, grip_force_of, opening_of, other_sign, width_error
from hmmseg.io.rig import Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, Trial
from hmmseg.robust import white_sd

WHERE = "stream"
BATCH = 0.02  # numerics: s of rows converted at once
BACKLOG = 10.0  # numerics: s before the first grip that are kept for the filter
APART = 8  # numerics: samples of free motion per window that identify the tool
KEPT = 30.0  # chosen: s of rows that identify the tool, and within which a grip may be refuted
AROUND = 4  # numerics: windows kept before the rows that are smoothed, for the same result as off line
TOUCHES = 8  # numerics: touches kept: a boundary looks back over fewer


class Wrist:
    """Takes rows of `rig.gripper.channels` at times in s and returns rows of a Cartesian hand.

    A returned row has 16 numbers: the Cartesian channels, the timing uncertainty of a change of force [s],
    the error of the tool's own load, across and up [N], and 0 where nothing is held, 2 where something is, 1
    close to a touch. `touch_sd` [m], `touches` [s, s]: as in `Trial`.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig, self.gripper, self.names = rig, rig.wrist, rig.wrist.channels
        self._rows: list[tuple[float, tuple[float, ...]]] = []  # the most recent, in order of time
        self._out = -math.inf  # time of the last row returned [s]
        self._opening = Opening(rig.fingertip.normal_stiffness)
        self._newest = dict.fromkeys(self.names, math.nan)  # last value of each channel
        self._window: float | None = None
        self._fitted = 0  # number of grips when the tool was last identified
        self.tool: Tool | None = None
        self.touches: list[tuple[float, float]] = []
        self.mark: float | None = None  # start of a new grip that has not been returned yet [s]
        self.back = False  # the last grip was refuted: rows since its start are returned again
        self.force_sd = 0.0  # error in a grip from a drift that free motion did not show [N]

    @property
    def touch_sd(self) -> float:
        """Uncertainty of the openings at which pads touch [m]."""
        return width_error([each.grip for each in self._opening.grips])

    @property
    def newest(self) -> float:
        """Time of the newest row [s], NaN before the first."""
        return self._rows[-1][0] if self._rows else math.nan

    @property
    def delay(self) -> float:
        """Delay of returned rows [s] while the gripper stands or is open."""
        return self._window or WINDOW

    def place(self, t: float, row: np.ndarray) -> str | None:
        """Insert a row in its place; returns its irregularity, in a word."""
        if self._rows and t <= self._rows[-1][0]:
            same = next((old for at, old in reversed(self._rows) if at == t), None)
            if same is not None:
                return "repeated" if np.array_equal(same, row, equal_nan=True) else "contradictory"
            if t <= self._out:
                return "too late"
            insort(self._rows, (t, tuple(row)), key=lambda each: each[0])
            return "late"
        self._rows.append((t, tuple(row)))
        self._newest |= {name: v for name, v in zip(self.names, row.tolist(), strict=True) if v == v}
        opening = sum(self._newest[name] for name in self.gripper.opening)
        if math.isfinite(opening):
            pressing = grip_force_of(self._newest, self.gripper)
            self._opening.follow(t, opening, math.nan if pressing is None else float(pressing))
        return None

    def ready(self, final: bool = False) -> list[tuple[float, np.ndarray]]:
        """Rows that are ready now, each once; with `final` all remaining ones."""
        if not self._rows:
            return []
        newest, opening = self.newest, self._opening
        if self._rows[0][0] < newest - 1.5 * KEPT:
            self._rows = self._since(newest - KEPT)
        if self.tool is None and not (opening.number or final):
            self._out = max(self._out, newest - BACKLOG)
            return []
        self._rewind()  # even where no row is ready: the next grip forgets a refuted one
        until = newest if final else min(newest - (self._window or 0.0), opening.known)
        if not final and until < self._out + BATCH and self._fitted == opening.number:
            return []
        out = self._converted(until)
        self._out = max(self._out, until)
        return out

    def _since(self, t: float) -> list[tuple[float, tuple[float, ...]]]:
        """Rows from t [s] on."""
        return self._rows[bisect_left(self._rows, t, key=lambda each: each[0]) :]

    def _rewind(self) -> None:
        """Go back to the start of a refuted grip."""
        refused, self._opening.refused = self._opening.refused, None
        if refused is None or not self._rows or refused.start <= self._rows[0][0]:
            return
        if refused.start <= self._out:
            self.back = True
            self._out = max(t for t, _ in self._rows if t < refused.start)
            self.touches = [touch for touch in self.touches if touch[0] <= self._out]

    def _trial(self, since: float) -> Trial:
        """Rows from a time [s] on."""
        rows = self._since(since)
        values = np.array([row for _, row in rows]).reshape(len(rows), -1)
        return Trial(WHERE, np.array([t for t, _ in rows]),
                     {name: values[:, i] for i, name in enumerate(self.names)})  # fmt: skip

    def _posed(self, trial: Trial) -> Pose:
        pose = pose_of(trial, self.gripper, self._window)
        self._window = pose.window
        return pose

    def _find_tool(self, until: float) -> None:
        """Identify the tool from free motion up to a time [s]; unchanged if there is none."""
        trial = self._trial(-math.inf)
        if not _has_values(trial):
            return
        pose = self._posed(trial)
        free = self._opening.free(trial.t, opening_of(trial, self.gripper))
        free = np.flatnonzero(free & (trial.t <= until))
        step = max(1, round(pose.window / APART / float(np.median(np.diff(trial.t)))))
        mask = np.zeros(trial.t.size, bool)
        mask[free[::step]] = True
        if self.tool is None or mask.any():
            motion = free_motion(trial, self.rig, pose, mask)
            since = float(motion.t.mean()) if motion.t.size else 0.0
            self.tool = tool_of(WHERE, self.rig, motion, since, between=self._fitted > 1)

    def _converted(self, until: float) -> list[tuple[float, np.ndarray]]:
        """Rows up to `until` as those of two fingers."""
        held = self._opening.held
        if self.tool is None or self._fitted != self._opening.number:
            self._fitted = self._opening.number
            self.mark = None if held is None else held.start
            self._find_tool(until)
        since = self._out if held is None or held.judged else min(held.start, self._out)
        trial = self._trial(since - AROUND * self.delay)
        if self.tool is None or not _has_values(trial):
            return [(t, np.full(16, np.nan)) for t in trial.t.tolist() if self._out < t <= until]
        return self._as_rows(trial, self._posed(trial), self.tool, until)

    def _as_rows(self, trial: Trial, pose: Pose, tool: Tool, until: float) -> list[tuple[float, np.ndarray]]:
        force, near, grips = applied_force(trial, self.rig, pose, tool), np.zeros(trial.t.size), []
        for held in self._opening.grips:
            start, stop = np.searchsorted(trial.t, [held.start, held.stop]).tolist()
            if stop > start:
                grips.append(replace(held.grip, start=start, stop=stop))
                near[max(start - 1, 0) : stop + 1] = 1.0
        for each in grips:
            near[each.start + 1 : each.stop - 1] = 2.0
        opening, pressing = opening_of(trial, self.gripper), grip_force_of(trial.channels, self.gripper)
        fingers = as_fingers(trial, self.rig, pose, tool, opening, force.copy(), grips, pressing)
        held = self._opening.held
        if held is not None and held.start <= until and not held.judged:
            start, stop = np.searchsorted(trial.t, [held.start, until]).tolist()
            load = bears(start, stop, pose, force, tool)
            held.judged = load is not None
            if load is not None and load < 0:
                raise other_sign(trial, self.rig, load)
            if load == 0.0:
                self._opening.refuse()
        if self._opening.held is not None:
            self.force_sd = max(self.force_sd, tool.drift_sd * abs(until - tool.since))
        self.touches += [touch for touch in fingers.touches if self._out < touch[0] <= until]
        del self.touches[:-TOUCHES]
        assert fingers.timing is not None and fingers.inertia is not None
        channels = [fingers.channels[name] for name in CARTESIAN_CHANNELS]
        table = np.stack([*channels, fingers.timing, *fingers.inertia.T, near], axis=1)
        table[np.isnan(np.stack(list(trial.channels.values()))).all(axis=0)] = np.nan
        chosen = np.flatnonzero((trial.t > self._out) & (trial.t <= until))
        return [(float(trial.t[i]), table[i]) for i in chosen]


def _has_values(trial: Trial) -> bool:
    """Whether every channel has a value to smooth."""
    return trial.t.size > 3 and all(np.isfinite(c).any() for c in trial.channels.values())


def checked(rig: Rig, t: float, row: np.ndarray) -> None:
    """Raise InputError for an impossible orientation, naming the time of the row."""
    gripper = rig.gripper
    if gripper is None or gripper.quaternion is None:
        return
    q = [row[gripper.channels.index(name)] for name in gripper.quaternion]
    norm = math.sqrt(sum(value * value for value in q))
    if math.isfinite(norm) and not abs(norm - 1) < 0.05:
        where = f"{WHERE}: t = {t:.9g} s: columns {', '.join(gripper.quaternion)}"
        raise InputError(where, f"a quaternion of norm {norm:.3g}", "a norm of 1 (x, y, z, w)")


LAG = 1.0  # chosen: s; default lag, and the longest that samples are held back: contacts ring for less
NOISE = 200  # numerics: samples that determine the opening's noise
REMEMBERED = 10.0  # numerics: s of a closing that are kept


@dataclass
class Held:
    """One grip, from `start` to `stop` [s], inf while it lasts; `grip` as off line.

    `judged`: whether the hand is known to bear a load.
    """

    start: float
    grip: Grip
    stop: float = math.inf
    judged: bool = False


class Opening(Closings):
    """Follows an opening sample by sample, between pads of a stiffness [N/m].

    `grips`: those of the last KEPT s. `known` [s]: time up to which it is known what is held. `number`: of
    grips so far. `refused`: the last grip, if it was refuted.
    """

    def __init__(self, stiffness: float) -> None:
        super().__init__(LEAST_CLOSING)
        self.stiffness, self.number, self.known = stiffness, 0, -math.inf
        self.grips: list[Held] = []
        self.refused: Held | None = None
        self._way: deque[tuple[float, float, float]] = deque()  # samples since it was widest
        self._low, self._high = math.inf, -math.inf
        self._noise, self._recent = 0.0, list[float]()
        self._fastest, self._wide = 0.0, math.nan

    @property
    def held(self) -> Held | None:
        """The current grip."""
        return self.grips[-1] if self.grips and self.grips[-1].stop == math.inf else None

    def free(self, t: np.ndarray, opening: np.ndarray) -> np.ndarray:
        """Samples that surely are free motion: outside every grip, more open than halfway."""
        free = t <= self.known
        for held in self.grips:
            free &= (t < held.start) | ((t >= held.stop) & (opening >= (held.grip.held + self._high) / 2))
        return free

    def follow(self, t: float, opening: float, pressing: float = math.nan) -> None:
        """Process a sample; `pressing` [N]: force of each pad, where known."""
        if len(self._recent) < NOISE:
            self._recent.append(opening)
            if len(self._recent) % (NOISE // 10) == 0:
                self._noise = max(self._noise, white_sd(np.array(self._recent[-NOISE // 10 :])))
        self._low, self._high = min(self._low, opening), max(self._high, opening)
        self.swing = least_swing(self._high - self._low, self._noise)
        turned = self.take(t, opening)
        if not self.closing and self.extreme[0] == t:
            self._way.clear()
        self._way.append((t, opening, pressing))
        while t - self._way[0][0] > REMEMBERED:
            self._way.popleft()
        if self.held is not None:
            self._hold(self.held, t, opening)
        elif self.closing:
            self._fastest *= not turned
            self._close(t, opening)
        else:
            self.known = t

    def _close(self, t: float, opening: float) -> None:
        """While closing, samples wait until the gripper stands: has hardly moved over WINDOW."""
        self.known = max(self.known, t - LAG)
        then = next((each for each in reversed(self._way) if t - each[0] >= WINDOW - 1e-9), None)
        if then is None:
            return
        speed = (then[1] - opening) / (t - then[0])
        self._fastest = max(self._fastest, speed)
        if speed >= REST * self._fastest:
            return
        times, way, pressing = np.array(self._way).T
        grip = grip_of(times, way, (0, int(way.argmin()), None), pressing, self.stiffness)
        if grip is None:
            self._restart(t, opening)
            return
        self.grips = [each for each in self.grips if each.stop > t - KEPT]
        self.grips.append(Held(max(float(times[grip.start]), self.known), grip))
        self.refused, self.known, self._wide = None, t, math.nan
        self.number += 1

    def _hold(self, held: Held, t: float, opening: float) -> None:
        """While held, samples wait if it may be letting go."""
        if opening < held.grip.held - self.swing:  # the closing had only paused
            self.refused, self.known = self.grips.pop(), held.start
        elif opening <= held.grip.width:  # on its way or not: the pads touch
            self._wide, self.known = math.nan, t
        else:
            self._wide = t if math.isnan(self._wide) else self._wide
            self.known = max(self.known, t - LAG)
            if not self.closing:
                held.stop, self.known = self._wide, t

    def refuse(self) -> None:
        """The current grip turns out to hold nothing."""
        self.refused = self.grips.pop()
        t, opening, _ = self._way[-1]
        self._restart(t, opening)

    def _restart(self, t: float, opening: float) -> None:
        self.closing, self.extreme, self.known = False, (t, opening), t
