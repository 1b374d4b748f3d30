"""Grips of a parallel gripper while it closes: what its opening has shown so far, and what it leaves open.

Off line a closing is read from both of its ends (`hmmseg.hand.wrist`). While it happens, a touch shows only
once the gripper stands, some tens of milliseconds after it; until then nobody knows whether samples since
it slowed down were of a grip. Those are held back.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from hmmseg.hand.wrist import LEAST_CLOSING, SLOWED, STEP, Grip, grip_of
from hmmseg.robust import NORMAL

STAND = 0.1  # chosen: s of next to no motion: the gripper stands
STILL = 0.1  # chosen: share of a closing's top speed that is next to none
SAMPLES = 4  # numerics: of a stand at least, and steps: what the touch is read from
PATIENCE = 1.0  # chosen: s that samples are held back at most, as long as a boundary is waited for
NOISE = 200  # numerics: samples that tell the opening's noise
CLEAR = 10.0  # chosen: noise scales of a motion, as off line
KEPT = 10.0  # numerics: s of a closing that are kept
OPENING = 0.1  # chosen: share of the way back at which a gripper has surely let go, as off line


class Held:
    """One grip: from `start` to `stop` [s], inf while it lasts; `grip` as off line."""

    def __init__(self, start: float, grip: Grip) -> None:
        self.start, self.stop, self.grip = start, math.inf, grip


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
        return max(0.1 * (self._high - self._low), CLEAR * self._noise, LEAST_CLOSING)

    def free(self, t: float, opening: float) -> bool:
        """Whether a sample is surely of free motion: outside of every grip, more open than halfway."""
        for held in self.grips:
            if t >= held.start and (t < held.stop or opening < (held.grip.held + self._high) / 2):
                return False
        return t <= self.known

    def take(self, t: float, opening: float) -> None:
        """The next sample."""
        self._learn_noise(opening)
        self._low, self._high = min(self._low, opening), max(self._high, opening)
        if self.held is not None:
            self._hold(t, opening)
            return
        kept = self._kept
        if not self.closing:
            if not kept or opening >= kept[0][1]:
                kept.clear()
            self._keep(t, opening)
            self.known = t
            if opening < kept[0][1] - self.swing:
                self.closing, self._fastest, self._slowed = True, 0.0, t
                self._floor = opening
            return
        self._keep(t, opening)
        self._close(t, opening)

    def _learn_noise(self, opening: float) -> None:
        """Noise of one sample [m] from second differences, as off line."""
        self._recent.append(opening)
        n = len(self._recent)
        if self._seen < NOISE and n == NOISE // 10:
            self._seen += n
            bent = np.abs(np.diff(self._recent, 2))
            self._noise = max(self._noise, NORMAL * float(np.median(bent)) / np.sqrt(6))
            self._recent.clear()

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
        if t - self._slowed < STAND or not self._speed(STAND) < STILL * self._fastest:
            return
        times, way = np.array(self._kept).T
        end = times.size - 1
        stands = end - int(np.argmax(way <= way[end] + OPENING * (way[0] - way[end])))
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
        self._keep(t, opening)
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
        if opening > max(held.grip.width, self._floor + OPENING * (self._high - self._floor)):
            held.stop = self._wide
            self._open(t, opening)

    def refuse(self) -> None:
        """The grip that lasts turns out to hold nothing."""
        self.refused = self.grips.pop()
        self._open(*self._kept[-1])

    def _keep(self, t: float, opening: float) -> None:
        self._kept.append((t, opening))
        while t - self._kept[0][0] > KEPT:
            self._kept.popleft()

    def _open(self, t: float, opening: float) -> None:
        self.closing, self.known = False, t
        self._floor = math.inf
        self._kept.clear()
        self._kept.append((t, opening))
