"""The virtual model driven by fingers whose motion is given: one step at a time, or a whole rollout.

`advance` and `rollout` are pure and differentiable; `VirtualModel` keeps the state between the
steps of a haptic loop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import NamedTuple

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
    Scalar,
    State,
    Tips,
    energy,
    interact,
    resting_state,
    substep,
)
from simgap.world.layout import standing_heights
from simgap.world.performance import Values
from simgap.world.properties import Block, Blocks
from simgap.world.scene import Surroundings, physics, substeps_for


class Rollout(NamedTuple):
    """Prediction at every given time; T times, 2 fingers, B blocks, axes x and y last.

    `force` (T, 2, 2) [N] that the fingers exert, `blocks`, `block_velocity` (T, B, 2) [m, m/s],
    `pads` (T, 2, B) normal forces and `support` (T, B) force from beneath [N].
    """

    force: Values
    blocks: Values
    block_velocity: Values
    pads: Values
    support: Values


def advance(constants: Physics, state: State, before: Tips, after: Tips, dt: Scalar,
            substeps: int) -> tuple[State, Loads]:  # fmt: skip
    """State and loads after dt [s] in which the tips go straight from one place to the next."""

    def between(share: Scalar) -> Tips:
        return jax.tree.map(lambda a, b: a + share * (b - a), before, after)

    def one(k: Array, state: State) -> State:
        return substep(constants, state, between((k + 0.5) / substeps), dt / substeps)

    return interact(constants, jax.lax.fori_loop(0, substeps, one, state), after)


@partial(jax.jit, static_argnames=("substeps",))
def rollout(constants: Physics, state: State, positions: Array, velocities: Array, dt: Scalar,
            substeps: int) -> Rollout:  # fmt: skip
    """Prediction from finger positions and velocities (T, 2, 2) [m, m/s] every dt [s], from `state` on."""

    def one(carry: tuple[State, Tips], row: Array) -> tuple[tuple[State, Tips], Array]:
        state, before = carry
        after = _tips(row)
        state, loads = advance(constants, state, before, after, dt, substeps)
        return (state, after), _row(state, loads)

    rows = jnp.concatenate([positions.reshape(-1, 4), velocities.reshape(-1, 4)], axis=1)
    _, out = jax.lax.scan(one, (state, _tips(rows[0])), rows)
    n = len(state.x)
    force, rest = out[:, :4].reshape(-1, 2, 2), out[:, 4:]
    blocks, speeds = rest[:, : 2 * n].reshape(-1, n, 2), rest[:, 2 * n : 4 * n].reshape(-1, n, 2)
    return Rollout(force, blocks, speeds, rest[:, 4 * n : 6 * n].reshape(-1, 2, n), rest[:, 6 * n :])


def standing(constants: Physics, task: BlockTask, x: Mapping[str, float]) -> State:
    """Blocks at rest as the task begins, each on its support, centres at x [m] by name."""
    heights = dict(zip(task.objects, map(float, constants.height), strict=True))
    y = standing_heights(task.initial, heights)
    return resting_state(constants, [jnp.asarray(x[name], float) for name in task.objects],
                         [jnp.asarray(y[name]) for name in task.objects])  # fmt: skip


class VirtualModel:
    """A scene to touch: give finger motions step by step, get the forces to render.

    `blocks` in the order of `task.objects` stand as the task begins, centres at x [m] by name.
    A program is compiled at the first step, or before it by `prepare`.
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
        """Put every block back to where it started."""
        self._state = self._start
        self._tips: np.ndarray | None = None
        self.energy = 0.0

    @double_precision
    def prepare(self, dt: float) -> None:
        """Compile for a period dt [s], so that no step of a loop has to."""
        jax.block_until_ready(self._advance(np.zeros(8), np.zeros(8), dt))

    @double_precision
    def step(self, finger_positions: ArrayLike, finger_velocities: ArrayLike, dt: float) -> np.ndarray:
        """Forces (2, 2) [N] that fingers 1, 2 exert (x, y) after moving for dt [s] to these positions.

        Positions and velocities (2, 2) [m, m/s]. A device renders the opposite. `energy` [J] is
        afterwards what blocks and contacts hold. ValueError for a shape or number that is not.
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
        """Blocks and contacts now."""
        return self._unravel(self._state)

    def block_positions(self) -> np.ndarray:
        """Centres of the blocks (num_blocks, 2) [m] now."""
        n = len(self.objects)
        return np.asarray(self._state)[: 2 * n].reshape(2, n).T  # a State begins with x and y

    def _advance(self, before: np.ndarray, after: np.ndarray, dt: float) -> tuple[Array, Array]:
        if dt not in self._substeps:
            self._substeps[dt] = substeps_for(self.physics, dt)
        program = _program(len(self.objects), self._substeps[dt])
        return program(self._constants, self._state, before, after, dt)


@lru_cache
def _program(num_blocks: int, substeps: int) -> Callable:
    """Compiled step on flat arrays: few arguments are quick to hand over, and any scene can use it."""
    block = [Block(1.0, 1.0, 1.0)] * num_blocks
    template = physics(Rig(), block)
    _, constants_of = ravel_pytree(template)
    _, state_of = ravel_pytree(
        resting_state(template, [jnp.zeros(())] * num_blocks, [jnp.zeros(())] * num_blocks)
    )

    def program(constants: Array, flat: Array, before: Array, after: Array, dt: Array) -> tuple[Array, Array]:
        scene, tips = constants_of(constants), _tips(after)
        state, loads = advance(scene, state_of(flat), _tips(before), tips, dt, substeps)
        held = energy(scene, state, tips)
        out = [loads.fx[0], loads.fy[0], loads.fx[1], loads.fy[1], held]
        return ravel_pytree(state)[0], jnp.stack(out)

    return jax.jit(program)


def _tips(row: Array) -> Tips:
    x1, y1, x2, y2, vx1, vy1, vx2, vy2 = (row[k] for k in range(8))
    return Tips((x1, x2), (y1, y2), (vx1, vx2), (vy1, vy2))


def _row(state: State, loads: Loads) -> Array:
    """Everything predicted, in the order in which `rollout` takes it apart."""
    pairs = [zip(loads.fx, loads.fy, strict=True), zip(state.x, state.y, strict=True),
             zip(state.vx, state.vy, strict=True)]  # fmt: skip
    values = [value for part in pairs for pair in part for value in pair]
    return jnp.stack([*values, *loads.pads[0], *loads.pads[1], *loads.support])
