"""One played world: the virtual model and a hand whose fingertips hang on springs from a command."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from simgap.play.felt import scene_with, sensed
from simgap.world.dynamics import CONTROL_PERIOD
from simgap.world.properties import Blocks
from simgap.world.virtual_model import VirtualModel

# look: a fingertip's mass [kg], spring [N/m] and damping (ratio): the middle of what operators are drawn
# with.
MASS, STIFFNESS, RATIO = 0.14, 450.0, 0.9
DAMPING = 2 * RATIO * np.sqrt(MASS * STIFFNESS)
WINDOW = 600  # look: ms of motion that a sensor's effect looks back on


class PlayedWorld:
    """Blocks and two fingertips; `advance` by a millisecond with the fingers' commanded places.

    `position`, `velocity`, `force` (2 fingers, 2 axes) [m, m/s, N]: the tips now and what they exert.
    """

    def __init__(
        self,
        task: BlockTask,
        rig: Rig,
        blocks: Blocks,
        x: Mapping[str, float],
        start: np.ndarray,
        effects: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self.effects = dict(effects or {})
        self.rig, self.blocks, around = scene_with(self.effects, rig, blocks)
        self.model = VirtualModel(self.rig, task, self.blocks, x, around)
        self.model.prepare(CONTROL_PERIOD)
        self.start = start
        self.reset()

    def reset(self) -> None:
        """Blocks back to where they stood, tips to where they began."""
        self.model.reset()
        self.position, self.velocity = self.start.copy(), np.zeros((2, 2))
        self.force = np.zeros((2, 2))
        self.t = 0.0
        self._past: deque[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = deque(maxlen=WINDOW)

    def advance(self, command: np.ndarray, rate: np.ndarray) -> None:
        """A millisecond: the springs pull the tips to `command` (2, 2) [m], moving at `rate` [m/s]."""
        pull = STIFFNESS * (command - self.position) + DAMPING * (rate - self.velocity)
        self.velocity = self.velocity + CONTROL_PERIOD / MASS * (pull - self.force)
        self.position = self.position + CONTROL_PERIOD * self.velocity
        self.force = self.model.step(self.position, self.velocity, CONTROL_PERIOD)
        self.t += CONTROL_PERIOD
        if self.effects:
            self._past.append((self.t, self.position, self.velocity, self.force))

    @property
    def felt(self) -> np.ndarray:
        """Forces (2, 2) [N] as this world's sensors say them."""
        if not self.effects or not self._past:
            return self.force
        t, position, velocity, force = map(np.array, zip(*self._past, strict=True))
        return sensed(self.effects, t, position, velocity, force, self.rig)[-1]
