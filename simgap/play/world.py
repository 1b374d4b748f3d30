"""A played world: the virtual model with perceptible effects, and a hand on springs that follows a
command."""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError, nearest
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from simgap.effects import catalogue
from simgap.effects.base import HandEffect, Performance
from simgap.gap.simulated import Values, altered, scene_of
from simgap.world.dynamics import CONTROL_PERIOD
from simgap.world.properties import Blocks
from simgap.world.virtual_model import Surroundings, VirtualModel, finite_stiffness

SOFTEST = 50.0  # look: N/m; a softer pad would let the fingers through
SLIPPIEST = 1e-3  # look: the least friction
OFTEN = 3.0  # look: prior standard deviations of a sensor effect that is strong enough to be seen


def felt_effects() -> dict[str, HandEffect]:
    """Effects that a played world can have."""
    return {
        name: effect for name, effect in catalogue().items()
        if effect.scene is not None
        or (effect.apply is not None and effect.acts_on == "sensing" and effect.played != {})
    }  # fmt: skip


def effect_values(name: str, given: Mapping[str, float] | None = None) -> dict[str, float]:
    """An effect's parameters, as given or strong enough to be felt; InputError for an unknown effect."""
    known = felt_effects()
    if name not in known:
        raise InputError(f"effect {name}", "cannot be felt in a played world", nearest(name, known))
    parameters, forms = known[name].parameters, known[name].forms
    nothing = {n: p.nominal if p.log or p.shape else 0.0 for n, p in parameters.items()}
    first = forms[0] if forms else tuple(nothing)  # forms overlap: gains of a finger and of both, say
    strong = {n: OFTEN * p.sd for n, p in parameters.items() if n in first and not (p.log or p.shape)}
    usual = known[name].played or nothing | ({} if given else strong)
    return dict(usual) | {key: float(value) for key, value in (given or {}).items() if np.isfinite(value)}


def scene_with(effects: Values, rig: Rig, blocks: Blocks) -> tuple[Rig, Blocks, Surroundings]:
    """Rig, blocks and surroundings under the scene effects among these, with pads stiff enough to play."""
    hand, around, blocks = scene_of(rig, blocks, effects)
    stiff = hand.fingertip.model_dump().items()
    pads = {n: float(np.clip(v, SOFTEST, finite_stiffness(np.inf))) for n, v in stiff}
    hand = hand.model_copy(update={"fingertip": hand.fingertip.model_copy(update=pads)})
    return hand, {n: replace(b, friction=max(b.friction, SLIPPIEST)) for n, b in blocks.items()}, around


def sensed(
    effects: Values, t: np.ndarray, position: np.ndarray, velocity: np.ndarray, force: np.ndarray, rig: Rig
) -> np.ndarray:
    """Forces (n, 2, 2) [N] read by sensors with these effects, during a motion at times t (n,) [s]."""
    nothing, known = np.zeros(t.size), felt_effects()
    mine = {name: values for name, values in effects.items() if known[name].acts_on == "sensing"}
    truth = Performance(t, position, velocity, force, np.zeros(0), rig, nothing, nothing + 1.0)
    return altered(truth, mine, np.random.default_rng(0)).force


# look: a fingertip's mass [kg], spring [N/m] and damping (ratio): the middle of the operators' ranges
MASS, STIFFNESS, RATIO = 0.14, 450.0, 0.9
DAMPING = 2 * RATIO * np.sqrt(MASS * STIFFNESS)
WINDOW = 600  # look: ms of motion that a sensor effect can look back on


class PlayedWorld:
    """Blocks and two fingertips; `advance` moves them by a millisecond under commanded finger positions.
    `position`, `velocity`, `force` (2 fingers, 2 axes) [m, m/s, N] of the tips, forces on the blocks."""

    def __init__(self, task: BlockTask, rig: Rig, blocks: Blocks, x: Mapping[str, float], start: np.ndarray,
                 effects: Values | None = None) -> None:  # fmt: skip
        self.effects = dict(effects or {})
        self.rig, self.blocks, around = scene_with(self.effects, rig, blocks)
        self.model = VirtualModel(self.rig, task, self.blocks, x, around)
        self.model.prepare(CONTROL_PERIOD)
        self.start = start
        self.reset()

    def reset(self) -> None:
        """Return blocks and tips to the start."""
        self.model.reset()
        self.position, self.velocity = self.start.copy(), np.zeros((2, 2))
        self.force = np.zeros((2, 2))
        self.t = 0.0
        self._past: deque[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = deque(maxlen=WINDOW)

    def advance(self, command: np.ndarray, rate: np.ndarray) -> None:
        """Advance a millisecond: springs pull the tips to `command` (2, 2) [m], moving at `rate` [m/s]."""
        pull = STIFFNESS * (command - self.position) + DAMPING * (rate - self.velocity)
        self.velocity = self.velocity + CONTROL_PERIOD / MASS * (pull - self.force)
        self.position = self.position + CONTROL_PERIOD * self.velocity
        self.force = self.model.step(self.position, self.velocity, CONTROL_PERIOD)
        self.t += CONTROL_PERIOD
        if self.effects:
            self._past.append((self.t, self.position, self.velocity, self.force))

    @property
    def felt(self) -> np.ndarray:
        """Forces (2, 2) [N] as read by this world's sensors."""

        if not self.effects or not self._past:
            return self.force
        t, position, velocity, force = map(np.array, zip(*self._past, strict=True))
        return sensed(self.effects, t, position, velocity, force, self.rig)[-1]
