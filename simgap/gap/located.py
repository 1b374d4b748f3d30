"""Where a gap lies: cells whose residuals show it, and those whose signals the named causes shift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from simgap.attribution.cells import Cell
from simgap.attribution.document import rows
from simgap.effects import fitted, name_of
from simgap.effects.base import World, tips
from simgap.gap.evaluation import raw_residual_at, world_without
from simgap.gap.fit import Fitted
from simgap.gap.problem import Problem
from simgap.gap.trial_arrays import CHANNELS

# cited: sds of a sample: mean shift of a cell that counts as shifted (the interface's definition)
SHIFTED = 3.0


def where(given: Problem, found: Sequence[Cell], causes: Fitted | None) -> list[dict[str, Any]]:
    """Rows of the document: significant cells and those that the causes shift, largest share first.

    Shares are of the excess that residuals show: a shift that the properties absorb has none.
    """
    frame = given.frame
    out = [{**row, "subtask": row["subtask"].partition(":")[2]} for row in rows(found)]
    if causes is None or not causes.effects:
        return out
    known = {(c.trial, c.channel, c.part) for c in found}
    mean = shifts(given, causes)
    for r, s, c in np.argwhere(mean >= SHIFTED):
        name = frame.steps[s].label
        if (frame.files[r], CHANNELS[c], f"{s}:{name}") not in known:
            out.append({"trial": frame.files[r], "channel": CHANNELS[c], "subtask": name,
                         "band": [0.0, 1.0], "share": 0.0, "z": float(mean[r, s, c])})  # fmt: skip
    return out


@dataclass(frozen=True)
class Tally:
    """Squared whitened residual of a trial's channel in a subtask over its `count`, as a normal score `z`."""

    trial: int
    channel: str
    subtask: int
    energy: float
    count: int
    z: float


def tallies(given: Problem, z: np.ndarray) -> tuple[Tally, ...]:
    """All cells of whitened residuals z (T, N, C) that hold anything."""
    frame, out = given.frame, []
    there = given.whitening.weight > 0
    for r in range(frame.num_trials):
        for s in range(len(frame.steps)):
            inside = frame.arrays.subtask[r] == s
            for c, channel in enumerate(CHANNELS):
                values = z[r, inside & there[r, :, c], c]
                if values.size:
                    energy, n = float(values @ values), values.size
                    # Wilson & Hilferty, PNAS 17, 1931
                    score = (np.cbrt(energy / n) - (1 - 2 / (9 * n))) / np.sqrt(2 / (9 * n))
                    out.append(Tally(r, channel, s, energy, n, float(score)))
    return tuple(out)


def shifts(given: Problem, causes: Fitted) -> np.ndarray:
    """Mean shift (T, S, C) of a cell under effects, in noise of one sample.

    What acts on sensors or kinematics shifts what is recorded. What acts on contact or dynamics shows in the
    equations of the contact as well; the larger of the two counts.
    """
    frame, u = given.frame, causes.u
    change = np.abs(channels(frame.world) - channels(world_without(given, causes.effects, u)))
    there = given.whitening.weight > 0
    mechanical = [e for e in causes.effects if fitted()[name_of(e)].acts_on not in ("sensing", "kinematics")]
    violated = np.zeros_like(change)
    if mechanical:
        rest = [e for e in causes.effects if e not in mechanical]
        violated = raw_residual_at(given, rest, u) - raw_residual_at(given, causes.effects, u)
        violated = np.where(there, violated, 0.0) / frame.arrays.sample
    change = change / frame.arrays.sample
    mean = np.zeros((frame.num_trials, len(frame.steps), len(CHANNELS)))
    for r in range(frame.num_trials):
        for s in range(len(frame.steps)):
            mine = np.flatnonzero(frame.arrays.subtask[r, : frame.lengths[r]] == s)
            if mine.size:
                number = np.maximum(there[r, mine].sum(0), 1)
                mean[r, s] = np.maximum(change[r, mine].mean(0), np.abs(violated[r, mine].sum(0)) / number)
    return mean


def channels(world: World) -> np.ndarray:
    """Task-space channels (T, N, C) of a world: x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    world = jax.tree.map(jnp.asarray, world)
    position, velocity = (np.asarray(z) for z in tips(world))
    force = np.asarray(world.force)
    mean, apart = (position[..., :2] + position[..., 2:]) / 2, position[..., 2:] - position[..., :2]
    speed = (velocity[..., :2] + velocity[..., 2:]) / 2
    net, half = force[..., :2] + force[..., 2:], (force[..., :2] - force[..., 2:]) / 2
    return np.concatenate([mean, apart, speed, net, half], -1)
