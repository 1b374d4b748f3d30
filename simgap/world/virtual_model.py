"""The virtual model driven by given finger motions, one step at a time or as a whole rollout.

`advance` and `rollout` are pure and differentiable; `VirtualModel` keeps the state between the steps of a
haptic loop.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.jaxconfig import double_precision
from simgap.world.dynamics import (
    Loads,
    Physics,
    Record,
    Scalar,
    State,
    Tips,
    energy,
    interact,
    record_of,
    resting_state,
    row_of,
    substep,
    tips_of,
)
from simgap.world.properties import Block, Blocks, standing_heights

# The calibrated scene: the constants of the dynamics, and the substeps that its fastest mode needs.

RIGID_PAD = 1e5  # numerics: N/m in place of inf: 3 N of grip compress such a pad by 0.03 mm


@dataclass(frozen=True)
class Surroundings:
    """What a rig does not state: supports and the foam's damping."""

    support_stiffness: float = 4e5  # [N/m]
    support_damping: float = 0.5  # ratio to critical for one block
    support_friction: float = 0.5
    pad_time: float = 2e-3  # [s] damping over stiffness of the foam
    tilt: float = 0.0  # [rad] of the ground


def physics(rig: Rig, blocks: Sequence[Block], surroundings: Surroundings | None = None) -> Physics:
    """Constants of the dynamics for blocks in order; a rigid pad gets the stiffness RIGID_PAD."""
    around = surroundings or Surroundings()
    normal, shear = map(finite_stiffness, (rig.fingertip.normal_stiffness, rig.fingertip.shear_stiffness))
    sizes = {key: tuple(getattr(b, key) for b in blocks) for key in ("weight", "width", "height", "friction")}
    pads = {"pad_normal": (normal, normal), "pad_shear": (shear, shear)}
    found = Physics(**sizes, **pads, **asdict(around), gravity=rig.gravity)
    return jax.tree.map(lambda value: jnp.asarray(value, float), found)


def finite_stiffness(stiffness: float) -> float:
    """A pad's stiffness [N/m], RIGID_PAD if it is rigid."""
    return stiffness if math.isfinite(stiffness) else RIGID_PAD


def substeps_for(constants: Physics, period: float) -> int:
    """Number of substeps, a power of two, in a period [s], well inside the stability limit. By Gershgorin's
    theorem no block oscillates faster than sqrt((4 supports + both pads) / mass): the step is at most 1.1
    over that (the limit is 2), 0.8 over the pads' damping rate, and 0.25 ms."""
    step = 2.5e-4
    pads = max(sum(map(float, constants.pad_normal)), sum(map(float, constants.pad_shear)))
    for w in constants.weight:
        mass = float(w) / float(constants.gravity)
        step = min(step, 1.1 / math.sqrt((4 * float(constants.support_stiffness) + pads) / mass))
        step = min(step, 0.8 / max(pads * float(constants.pad_time) / mass, 1e-9))
    return 2 ** max(0, math.ceil(math.log2(period / step) - 1e-9))


def advance(constants: Physics, state: State, before: Tips, after: Tips, dt: Scalar,
            substeps: int) -> tuple[State, Loads]:  # fmt: skip
    """State and loads after dt [s] of straight tip motion."""

    def between(share: Scalar) -> Tips:
        return jax.tree.map(lambda a, b: a + share * (b - a), before, after)

    def one(k: Array, state: State) -> State:
        return substep(constants, state, between((k + 0.5) / substeps), dt / substeps)

    return interact(constants, jax.lax.fori_loop(0, substeps, one, state), after)


@partial(jax.jit, static_argnames=("substeps",))
def rollout(constants: Physics, state: State, positions: Array, velocities: Array, dt: Scalar,
            substeps: int) -> Record:  # fmt: skip
    """Rollout from `state` as fingers move through positions, velocities (T, 2, 2) [m, m/s] every dt [s]."""

    def one(carry: tuple[State, Tips], row: Array) -> tuple[tuple[State, Tips], Array]:
        state, before = carry
        after = tips_of(row)
        state, loads = advance(constants, state, before, after, dt, substeps)
        return (state, after), row_of(state, after, loads)

    rows = jnp.concatenate([positions.reshape(-1, 4), velocities.reshape(-1, 4)], axis=1)
    _, out = jax.lax.scan(one, (state, tips_of(rows[0])), rows)
    return record_of(out, len(state.x))


def standing(constants: Physics, task: BlockTask, x: Mapping[str, float]) -> State:
    """Blocks at rest on their supports at the start of the task, centred at x [m] by name."""
    heights = dict(zip(task.objects, map(float, constants.height), strict=True))
    y = standing_heights(task.initial, heights)
    return resting_state(constants, [jnp.asarray(x[name], float) for name in task.objects],
                         [jnp.asarray(y[name]) for name in task.objects])  # fmt: skip


class VirtualModel:
    """A scene to touch: takes finger motions step by step and returns the forces to render.

    Blocks stand as at the start of the task, centred at x [m] by name. A program is compiled at the first
    step, or earlier by `prepare`.
    """

    @double_precision
    def __init__(self, rig: Rig, task: BlockTask, blocks: Blocks, x: Mapping[str, float],
                 surroundings: Surroundings | None = None) -> None:  # fmt: skip
        self.physics = physics(rig, [blocks[name] for name in task.objects], surroundings)
        self.objects = task.objects
        self._constants, _ = ravel_pytree(self.physics)
        self._start, self._unravel = ravel_pytree(standing(self.physics, task, x))
        self._substeps: dict[float, int] = {}
        self.reset()

    def reset(self) -> None:
        """Return every block to its start."""
        self._state = self._start
        self._tips: np.ndarray | None = None
        self.energy = 0.0

    @double_precision
    def prepare(self, dt: float) -> None:
        """Compile the step for a period dt [s] before a loop begins."""
        jax.block_until_ready(self._advance(np.zeros(8), np.zeros(8), dt))  # type: ignore[no-untyped-call]

    @double_precision
    def step(self, finger_positions: ArrayLike, finger_velocities: ArrayLike, dt: float) -> np.ndarray:
        """Move the fingers, advance the blocks, and update `energy` [J] of blocks and contacts.

        Args:
            finger_positions: (2, 2) [m] at the end of the step, fingers 1 and 2, x and y.
            finger_velocities: (2, 2) [m/s] at the end of the step.
            dt: Period [s].

        Returns:
            Forces (2, 2) [N] exerted by the fingers; a haptic device renders the opposite.

        Raises:
            ValueError: A shape is wrong or a number is not finite.
        """
        tips = np.empty(8)
        tips[:4] = np.reshape(finger_positions, 4)
        tips[4:] = np.reshape(finger_velocities, 4)
        if not (np.isfinite(tips).all() and dt > 0):
            raise ValueError(f"finger motion {tips} over {dt} s; expected finite numbers and dt > 0")
        before = tips if self._tips is None else self._tips
        self._state, out = self._advance(before, tips, dt)
        self._tips = tips
        values = np.asarray(out)
        self.energy = float(values[4])
        return values[:4].reshape(2, 2)

    @property
    @double_precision
    def state(self) -> State:
        """Current state of blocks and contacts."""
        return self._unravel(self._state)

    def block_positions(self) -> np.ndarray:
        """Current centres of the blocks (num_blocks, 2) [m]."""
        n = len(self.objects)
        return np.asarray(self._state)[: 2 * n].reshape(2, n).T  # a State begins with x and y

    def _advance(self, before: np.ndarray, after: np.ndarray, dt: float) -> tuple[Array, Array]:
        if dt not in self._substeps:
            self._substeps[dt] = substeps_for(self.physics, dt)
        program = _program(len(self.objects), self._substeps[dt])
        return program(self._constants, self._state, before, after, dt)


@lru_cache
def _program(num_blocks: int, substeps: int) -> Callable[..., Any]:
    """A compiled step on flat arrays, for any scene; few arguments make the call fast."""
    block = [Block(1.0, 1.0, 1.0)] * num_blocks
    template = physics(Rig(), block)
    _, constants_of = ravel_pytree(template)
    nowhere = [jnp.zeros(())] * num_blocks
    _, state_of = ravel_pytree(resting_state(template, nowhere, nowhere))

    def program(constants: Array, flat: Array, before: Array, after: Array, dt: Array) -> tuple[Array, Array]:
        scene, tips = constants_of(constants), tips_of(after)
        state, loads = advance(scene, state_of(flat), tips_of(before), tips, dt, substeps)
        held = energy(scene, state, tips)
        out = [loads.fx[0], loads.fy[0], loads.fx[1], loads.fy[1], held]
        return ravel_pytree(state)[0], jnp.stack(out)

    return jax.jit(program)
