"""Which cells an effect shifts: what it does to the signals themselves, and to the contact equations."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects.base import World, tips
from simgap.gap.fit import Problem, raw_residual_at, world_without


def shifts(given: Problem, effects: Sequence[str], u: np.ndarray) -> np.ndarray:
    """Mean shift (T, S, C) of a cell under the effects at coordinates u, in noise of one sample.

    A sensor's or a joint's effect shifts what is recorded; a contact's shows in the equations of the
    contact. The larger of the two counts.
    """
    frame = given.frame
    recorded, nominal = _channels(frame.world), _channels(world_without(given, effects, u))
    there = given.whitening.weight > 0
    violated = np.where(there, raw_residual_at(given, (), u) - raw_residual_at(given, effects, u), 0.0)
    out = np.zeros((frame.num_trials, len(frame.steps), recorded.shape[2]))
    for r in range(frame.num_trials):
        n = frame.lengths[r]
        for s in range(len(frame.steps)):
            mine = np.flatnonzero(frame.arrays.subtask[r, :n] == s)
            if mine.size:
                signal = (recorded - nominal)[r, mine].mean(0)
                equation = violated[r, mine].sum(0) / np.maximum(there[r, mine].sum(0), 1)
                out[r, s] = np.maximum(np.abs(signal), np.abs(equation)) / frame.arrays.sample[r]
    return out


def _channels(world: World) -> np.ndarray:
    """Task-space channels (T, N, C) of a world: x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    world = jax.tree.map(jnp.asarray, world)
    position, velocity = (np.asarray(z) for z in tips(world))
    force = np.asarray(world.force)
    mean, apart = (position[..., :2] + position[..., 2:]) / 2, position[..., 2:] - position[..., :2]
    speed = (velocity[..., :2] + velocity[..., 2:]) / 2
    net, half = force[..., :2] + force[..., 2:], (force[..., :2] - force[..., 2:]) / 2
    return np.concatenate([mean, apart, speed, net, half], -1)
