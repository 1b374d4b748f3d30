"""Which cells an effect shifts: what it does to the signals themselves, and to the contact equations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from simgap.effects import fitted
from simgap.effects.base import World, gradient, tips
from simgap.gap.candidate import Candidate
from simgap.gap.fit import Problem, raw_residual_at, world_without
from simgap.gap.frame import CHANNELS

YIELDS = frozenset({"grip_slip", "table_compliance"})  # effects that show as a path from where a grip began
PUSHES = frozenset({"cable_force", "viscous_drag"})  # those that displace the hand that bears them
RELAXES = "fingertip_creep"  # pads that give way while they are held: the hand grips the less
HAND = 700.0  # N/m of a finger; no recording tells it, this was set on the cables of the ninth blind set


def shifts(given: Problem, candidate: Candidate) -> np.ndarray:
    """Mean shift (T, S, C) of a cell under a candidate's effects, in noise of one sample.

    A sensor's or a joint's effect shifts what is recorded. What acts on contact shows in the equations of
    the contact as well; the larger of the two counts. A hand is as stiff as HAND: it gives way to what pushes
    it, and grips the less the farther pads creep. Times that are off at random shift the mean of a cell by so
    much in root mean square.
    """
    frame, effects, u = given.frame, candidate.fitted.effects, candidate.fitted.u
    without = world_without(given, effects, u)
    recorded = _channels(frame.world)
    change = recorded - _channels(without)
    change[..., CHANNELS.index("shear")] += _couple(given, without, u)
    change[..., CHANNELS.index("y")] += _inclined(given, without)
    if not PUSHES.isdisjoint(effects):
        for path, force in (("x", "fx"), ("y", "fy")):
            change[..., CHANNELS.index(path)] -= change[..., CHANNELS.index(force)] / (2 * HAND)
    there = given.whitening.weight > 0
    mechanical = [
        e for e in effects if fitted()[e].acts_on not in ("sensing", "kinematics") and e != "table_tilt"
    ]
    violated = np.zeros_like(change)
    if mechanical:
        others = [e for e in effects if e not in mechanical]
        violated = np.where(
            there, raw_residual_at(given, others, u) - raw_residual_at(given, effects, u), 0.0
        )
        if not YIELDS.isdisjoint(mechanical):
            _from_pickup(given, violated)
        if RELAXES in mechanical:
            grip, distance = CHANNELS.index("grip"), CHANNELS.index("distance")
            violated[..., grip] = HAND * np.abs(violated[..., distance]) / 2
            there = there.copy()
            there[..., grip] = there[..., distance]
    jitter = np.zeros_like(change)
    if candidate.spread is not None and candidate.spread.effect == "clock_jitter":
        jitter = candidate.spread.value * np.asarray(gradient(frame.world.t, recorded))
    sample = frame.arrays.sample
    change, violated, jitter = change / sample, violated / sample, jitter / sample
    mean = np.zeros((frame.num_trials, len(frame.steps), change.shape[2]))
    for r in range(frame.num_trials):
        n = frame.lengths[r]
        for s in range(len(frame.steps)):
            mine = np.flatnonzero(frame.arrays.subtask[r, :n] == s)
            if mine.size:
                signal, number = change[r, mine].mean(0), np.maximum(there[r, mine].sum(0), 1)
                equation = violated[r, mine].sum(0) / number
                scatter = np.sqrt((jitter[r, mine] ** 2).sum(0)) / mine.size
                mean[r, s] = np.hypot(np.maximum(np.abs(signal), np.abs(equation)), scatter)
    return mean


def _inclined(given: Problem, world: World) -> np.ndarray:
    """Height (T, N) [m] of the support over where the first grip took its block."""
    x = _channels(given.frame.world)[..., CHANNELS.index("x")]
    first = _pickup(given, 0)
    start = (x * first).sum(1, keepdims=True) / np.maximum(first.sum(1, keepdims=True), 1)
    return np.tan(np.asarray(world.tilt)) * (x - start)


def _pickup(given: Problem, move: int) -> np.ndarray:
    """Samples (T, N) of a move's pickup, 1 or 0."""
    arrays = given.frame.arrays
    return arrays.phase[..., 1] * arrays.onehot[..., move]


def _from_pickup(given: Problem, violated: np.ndarray) -> None:
    """Shifts (T, N, C) of a grip from where it was in its pickup, in place.

    What gives way under a load lets go of as much force as the pads have for that path.
    """
    arrays, pads = given.frame.arrays, given.frame.rig.fingertip
    there = given.whitening.weight > 0
    for move in range(arrays.onehot.shape[2]):
        mine, first = arrays.onehot[..., move] * (arrays.phase[..., 0] == 0), _pickup(given, move)
        for channel in ("y", "offset"):
            c = CHANNELS.index(channel)
            known = first * there[..., c]
            start = (violated[..., c] * known).sum(1) / np.maximum(known.sum(1), 1)
            violated[..., c] -= np.where(there[..., c], mine * start[:, None], 0.0)
    stiffness = np.where(arrays.phase[..., 3] > 0, pads.shear_stiffness, 0.0)
    for path, force, share in (("y", "fy", 2.0), ("offset", "shear", 0.5)):
        violated[..., CHANNELS.index(force)] = share * stiffness * violated[..., CHANNELS.index(path)]


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
