"""Rows of a gripper with a sensor in its wrist as the two fingers that a filter follows.

As `hmmseg.hand.wrist`, from the rows so far. What the tool itself puts on the sensor is found from
the free motion before the first grip, so nothing can be said before that (all of it is the task's first
subtask anyhow), and anew at every further one. Motion is smoothed over a window, so rows come out a window
late; while the gripper closes or lets go, until it is known when it touched: a touch shows only once the
gripper stands.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.grips import LEAST_CLOSING, REST, Closings, Grip, grip_of, least_swing
from hmmseg.hand.tool import WINDOW, FreeMotion, Pose, Tool, applied_force, free_motion, pose_of, tool_of
from hmmseg.hand.wrist import as_fingers, bears, grip_force_of, other_sign
from hmmseg.io.rig import Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, Trial
from hmmseg.robust import bridged, white_sd

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
        self._opening = Opening(rig.fingertip.normal_stiffness)
        self._newest = dict.fromkeys(self.names, math.nan)  # of each channel
        self._window: float | None = None
        self._free: FreeMotion | None = None
        self._free_until = -math.inf
        self._fitted = 0  # grips before which the tool was found
        self.tool: Tool | None = None
        self.touches: list[tuple[float, float]] = []
        self.mark: float | None = None  # start of a new grip, which has not come out yet [s]
        self.back = False  # the last grip was none: what has come out since it began comes again
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
        self._newest |= {name: v for name, v in zip(self.names, row.tolist(), strict=True) if v == v}
        opening = sum(self._newest[name] for name in self.gripper.opening)
        if math.isfinite(opening):
            pressing = grip_force_of(self._newest, self.gripper)
            self._opening.follow(t, opening, math.nan if pressing is None else float(pressing))
        return None

    def ready(self, final: bool = False) -> list[tuple[float, np.ndarray]]:
        """Rows that are ready now, each once; with `final` all that are left."""
        if not self._rows:
            return []
        newest, opening = self.newest, self._opening
        if self.tool is None and not (opening.number or final):
            if self._rows[0][0] < newest - BACKLOG:  # older free motion is kept as what it says of the tool
                trial = self._trial()
                if _has_values(trial):
                    self._gather(trial, self._posed(trial), newest - BACKLOG / 2)
                self._rows = [each for each in self._rows if each[0] >= newest - BACKLOG / 2]
            return []
        until = newest if final else min(newest - (self._window or 0.0), opening.known)
        if not final and until < self._out + BATCH and self._fitted == opening.number:
            return []
        self._return()
        out = self._turned(until)
        self._out = max(self._out, until)
        keep, held = self._out, opening.held or opening.refused
        if held is not None and held.start > self._out - KEPT:
            keep = min(keep, held.start)
        self._rows = [each for each in self._rows if each[0] > keep - AROUND * (self._window or 0.0)]
        return out

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

    def _trial(self) -> Trial:
        values = np.array([row for _, row in self._rows])
        return Trial(WHERE, np.array([t for t, _ in self._rows]),
                     {name: values[:, i] for i, name in enumerate(self.names)})  # fmt: skip

    def _posed(self, trial: Trial) -> Pose:
        pose = pose_of(trial, self.gripper, self._window)
        self._window = pose.window
        return pose

    def _opened(self, trial: Trial) -> np.ndarray:
        """Opening (num_timesteps,) [m], gaps bridged."""
        return np.sum([bridged(trial.channels[name], trial.t) for name in self.gripper.opening], axis=0)

    def _gather(self, trial: Trial, pose: Pose, until: float) -> None:
        """Add free motion up to `until` to what the tool is found from."""
        free = self._opening.free(trial.t, self._opened(trial)) & (trial.t > self._free_until)
        step = max(1, round(pose.window / APART / float(np.median(np.diff(trial.t)))))
        picked = np.flatnonzero(free & (trial.t <= until))[::step]
        self._free_until = max(self._free_until, min(until, float(trial.t[-1])))
        if picked.size:
            found = free_motion(trial, self.rig, pose, np.isin(np.arange(trial.t.size), picked))
            self._free = found if self._free is None else self._free.followed_by(found, FREE)

    def _turned(self, until: float) -> list[tuple[float, np.ndarray]]:
        """Rows up to `until` as those of two fingers."""
        trial, opening = self._trial(), self._opening
        if not _has_values(trial):
            return [(t, np.full(16, np.nan)) for t, _ in self._rows if self._out < t <= until]
        pose, first = self._posed(trial), self.tool is None
        self._gather(trial, pose, until)
        if first or self._fitted != opening.number:
            self._fitted = opening.number
            self.mark = None if opening.held is None else opening.held.start
            motion = self._free or free_motion(trial, self.rig, pose, np.zeros(trial.t.size, bool))
            if first or motion.t.size:
                since = float(motion.t.mean()) if motion.t.size else 0.0
                self.tool = tool_of(WHERE, self.rig, motion, since, between=self._fitted > 1)
        assert self.tool is not None
        return self._as_rows(trial, pose, self.tool, until)

    def _as_rows(self, trial: Trial, pose: Pose, tool: Tool, until: float) -> list[tuple[float, np.ndarray]]:
        force, near, grips = applied_force(trial, self.rig, pose, tool), np.zeros(trial.t.size), []
        for held in self._opening.grips:
            start, stop = np.searchsorted(trial.t, [held.start, held.stop]).tolist()
            if stop > start:
                grips.append(replace(held.grip, start=start, stop=stop))
                near[max(start - 1, 0) : stop + 1] = 1.0
        for each in grips:
            near[each.start + 1 : each.stop - 1] = 2.0
        found = as_fingers(trial, self.rig, pose, tool, self._opened(trial), force.copy(), grips,
                           grip_force_of(trial.channels, self.gripper))  # fmt: skip
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


def _has_values(trial: Trial) -> bool:
    """Whether every channel has a value to smooth."""
    return trial.t.size > 3 and all(np.isfinite(c).any() for c in trial.channels.values())


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
PATIENCE = 1.0  # chosen: s that samples are held back at most, as long as a boundary is waited for
NOISE = 200  # numerics: samples that determine the opening's noise
REMEMBERED = 10.0  # numerics: s of a closing that are kept


@dataclass
class Held:
    """One grip: from `start` to `stop` [s], inf while it lasts; `grip` as off line.

    `judged`: whether it is known that the hand bears something.
    """

    start: float
    grip: Grip
    stop: float = math.inf
    judged: bool = False


class Opening(Closings):
    """Follows an opening, sample by sample, between pads of a stiffness [N/m].

    `grips`: the last two. `known` [s]: up to when it is known what is held. `number`: grips so far.
    `refused`: the last one, where it was none.
    """

    def __init__(self, stiffness: float) -> None:
        super().__init__(LEAST_CLOSING)
        self.stiffness, self.number, self.known = stiffness, 0, -math.inf
        self.grips: deque[Held] = deque(maxlen=2)
        self.refused: Held | None = None
        self._way: deque[tuple[float, float, float]] = deque()  # since it was widest
        self._low, self._high = math.inf, -math.inf
        self._noise, self._recent = 0.0, []
        self._fastest, self._wide = 0.0, math.nan

    @property
    def held(self) -> Held | None:
        """The grip that lasts."""
        return self.grips[-1] if self.grips and self.grips[-1].stop == math.inf else None

    def free(self, t: np.ndarray, opening: np.ndarray) -> np.ndarray:
        """Which samples are surely of free motion: outside of every grip, more open than halfway."""
        free = t <= self.known
        for held in self.grips:
            free &= (t < held.start) | ((t >= held.stop) & (opening >= (held.grip.held + self._high) / 2))
        return free

    def follow(self, t: float, opening: float, pressing: float = math.nan) -> None:
        """The next sample; `pressing` [N]: what each pad presses with, where it is known."""
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
        """Samples wait until it stands."""
        self.known = max(self.known, t - PATIENCE)
        then = next((each for each in reversed(self._way) if t - each[0] >= STAND - 1e-9), None)
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
        self.grips.append(Held(max(float(times[grip.start]), self.known), grip))
        self.refused, self.known, self._wide = None, t, math.nan
        self.number += 1

    def _hold(self, held: Held, t: float, opening: float) -> None:
        """Samples wait while it may be letting go."""
        if opening < held.grip.held - self.swing:  # it had only paused
            self.refused, self.known = self.grips.pop(), held.start
        elif self.closing and opening <= held.grip.width:
            self._wide, self.known = math.nan, t
        else:
            self._wide = t if math.isnan(self._wide) else self._wide
            self.known = max(self.known, t - PATIENCE)
            if not self.closing:
                held.stop, self.known = self._wide, t

    def refuse(self) -> None:
        """The grip that lasts turns out to hold nothing."""
        self.refused = self.grips.pop()
        t, opening, _ = self._way[-1]
        self._restart(t, opening)

    def _restart(self, t: float, opening: float) -> None:
        self.closing, self.extreme, self.known = False, (t, opening), t
