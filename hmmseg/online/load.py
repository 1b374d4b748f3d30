"""Whether a hand that seems to hold something bears anything, once it has gone somewhere."""

from __future__ import annotations

import math

import numpy as np

from hmmseg.hand.wrist import TOGETHER
from hmmseg.levels import MOVED, SURE
from hmmseg.robust import robust_sd

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
