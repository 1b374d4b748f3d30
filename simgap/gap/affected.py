"""Which cells an effect shifts: what it does to the signals themselves, and to the contact equations."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects import fitted
from simgap.effects.base import World, tips
from simgap.gap.fit import Problem, raw_residual_at, world_without
from simgap.gap.frame import CHANNELS


def shifts(given: Problem, effects: Sequence[str], u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and rms shift (T, S, C) of a cell under the effects at coordinates u, in noise of one sample.

    A sensor's or a joint's effect shifts what is recorded. What acts on contact shows in the equations of
    the contact as well; the larger of the two counts.
    """
    frame = given.frame
    without = world_without(given, effects, u)
    change = _channels(frame.world) - _channels(without)
    change[..., CHANNELS.index("shear")] += _couple(given, without, u)
    there = given.whitening.weight > 0
    mechanical = [e for e in effects if fitted()[e].acts_on not in ("sensing", "kinematics")]
    violated = np.zeros_like(change)
    if mechanical:
        others = [e for e in effects if e not in mechanical]
        violated = np.where(
            there, raw_residual_at(given, others, u) - raw_residual_at(given, effects, u), 0.0
        )
    mean = np.zeros((frame.num_trials, len(frame.steps), change.shape[2]))
    rms = np.zeros_like(mean)
    for r in range(frame.num_trials):
        n = frame.lengths[r]
        for s in range(len(frame.steps)):
            mine = np.flatnonzero(frame.arrays.subtask[r, :n] == s)
            if mine.size:
                signal, number = change[r, mine], np.maximum(there[r, mine].sum(0), 1)
                equation, square = violated[r, mine].sum(0) / number, (violated[r, mine] ** 2).sum(0) / number
                mean[r, s] = np.maximum(np.abs(signal.mean(0)), np.abs(equation)) / frame.arrays.sample[r]
                rms[r, s] = np.sqrt(np.maximum((signal**2).mean(0), square)) / frame.arrays.sample[r]
    return mean, rms


def _couple(given: Problem, world: World, u: np.ndarray) -> np.ndarray:
    """Shear (T, N) [N] that balances a mass beside the middle of the carried block."""
    arrays = given.frame.arrays
    blocks = given.centre + given.spread * u[: given.num_properties].reshape(given.centre.shape)
    own = np.einsum("tnm,mo,op->tnp", arrays.onehot, arrays.objects, blocks)
    return np.asarray(world.couple * own[..., 0] / np.maximum(own[..., 1], 1e-3) * world.carry)


def _channels(world: World) -> np.ndarray:
    """Task-space channels (T, N, C) of a world: x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    world = jax.tree.map(jnp.asarray, world)
    position, velocity = (np.asarray(z) for z in tips(world))
    force = np.asarray(world.force)
    mean, apart = (position[..., :2] + position[..., 2:]) / 2, position[..., 2:] - position[..., :2]
    speed = (velocity[..., :2] + velocity[..., 2:]) / 2
    net, half = force[..., :2] + force[..., 2:], (force[..., :2] - force[..., 2:]) / 2
    return np.concatenate([mean, apart, speed, net, half], -1)
