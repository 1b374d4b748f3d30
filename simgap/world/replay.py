"""Replay: a recording's finger motions drive the virtual model, which predicts forces and blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import GROUND, BlockTask
from hmmseg.io.trial import Trial
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.align import segment
from simgap.world.performance import BUCKET, CONTROL_PERIOD
from simgap.world.properties import Blocks
from simgap.world.scene import Surroundings, physics, substeps_for
from simgap.world.smoothing import Motion, smooth
from simgap.world.virtual_model import Rollout, rollout, standing

APART = 0.1  # look: m; where a block stands that the recording never locates

# physics: mean and difference coordinates (x, y, distance, offset) from tips (x1, y1, x2, y2), and back.
TO_MEAN = np.array([[0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5], [-1, 0, 1, 0], [0, -1, 0, 1]])
TO_TIPS = np.linalg.inv(TO_MEAN)


@dataclass(frozen=True)
class Replay:
    """Predictions for one recording; T samples, 2 fingers, axes x and y last.

    `force` (T, 2, 2) [N] predicted at the samples, `measured` (T, 2, 2) [N] as recorded.
    `t` [s], `tips` (steps, 2, 2) [m] and `motion` hold the whole replay at 1 kHz.
    """

    signals: Signals
    force: np.ndarray
    measured: np.ndarray
    t: np.ndarray
    tips: np.ndarray
    motion: Rollout

    @property
    def predicted(self) -> dict[str, np.ndarray]:
        """Predicted grip, net forces fx, fy and shear (T,) [N], as `Signals` has them measured."""
        (fx1, fy1), (fx2, fy2) = (self.force[:, finger].T for finger in (0, 1))
        return {"grip": np.minimum(fx1, -fx2), "fx": fx1 + fx2, "fy": fy1 + fy2, "shear": (fy1 - fy2) / 2}

    @property
    def residual(self) -> np.ndarray:
        """Measured minus predicted forces (T, 2, 2) [N]."""
        return self.measured - self.force


@double_precision
def replay(trial: Trial, task: BlockTask, rig: Rig, blocks: Blocks, *,
           boundaries: Sequence[float] | np.ndarray | None = None, surroundings: Surroundings | None = None,
           ) -> Replay:  # fmt: skip
    """Drive the calibrated model with a recording's motion.

    `boundaries` [s] between the subtasks say which block is where; without them the trial is
    segmented.
    """
    signals = task_space(trial, rig)
    if boundaries is None:
        found = segment([trial], task, rig)[0]
        boundaries = [span.start for span in found.spans[1:]]
    path = finger_motion(signals)
    t = np.arange(signals.t[0], signals.t[-1] + CONTROL_PERIOD / 2, CONTROL_PERIOD)
    position, velocity = (z @ TO_TIPS.T for z in path.at(t))
    constants = physics(rig, [blocks[name] for name in task.objects], surroundings)
    start = standing(constants, task, places(signals, path, task, np.asarray(boundaries)))
    tips = _padded(position).reshape(-1, 2, 2)
    motion = rollout(constants, start, jnp.asarray(tips), jnp.asarray(_padded(velocity).reshape(-1, 2, 2)),
                     CONTROL_PERIOD, substeps_for(constants, CONTROL_PERIOD))  # fmt: skip
    motion = jax.tree.map(lambda a: np.asarray(a)[: t.size], motion)
    force = np.stack([np.interp(signals.t, t, column) for column in motion.force.reshape(-1, 4).T], -1)
    measured = np.stack([signals.fx1, signals.fy1, signals.fx2, signals.fy2], -1)
    return Replay(signals, force.reshape(-1, 2, 2), measured.reshape(-1, 2, 2), t, tips[: t.size], motion)


def finger_motion(signals: Signals) -> Motion:
    """Smoothed motion in x, y, distance, offset: in a grip the last two rest while the hand moves."""
    pick = lambda names: np.stack([getattr(signals, name) for name in names], 1)  # noqa: E731
    scale = np.sqrt([1.0, 1.0, 4.0, 4.0])  # sd_* are those of a mean of two; differences have twice
    return smooth(signals.t, pick(("x", "y", "distance", "offset")),
                  np.stack([signals.vx, signals.vy, signals.vx2 - signals.vx1, signals.vy2 - signals.vy1], 1),
                  pick(("sd_x", "sd_y", "sd_x", "sd_y")) * scale,
                  pick(("sd_vx", "sd_vy", "sd_vx", "sd_vy")) * scale)  # fmt: skip


def places(signals: Signals, path: Motion, task: BlockTask, boundaries: np.ndarray) -> dict[str, float]:
    """Where every block stands at first [m]: where it is first gripped, or first built upon."""
    x: dict[str, float] = {}
    moved: set[str] = set()

    def during(start: float, end: float) -> float:
        inside = (signals.t >= start) & (signals.t < end)
        return float(np.interp((start + end) / 2, signals.t, path.position[:, 0])
                     if not inside.any() else np.median(path.position[inside, 0]))  # fmt: skip

    for k, move in enumerate(task.performed):
        touch, leave, meet, part = boundaries[4 * k : 4 * k + 4]
        if move.object not in moved:
            x.setdefault(move.object, during(touch, leave))
        if move.to != GROUND and move.to not in moved and not move.slide:
            x.setdefault(move.to, during(meet, part))
        moved.add(move.object)
    for _ in task.objects:  # blocks of one pile stand over one another
        for name, on in task.initial.items():
            if on != GROUND and name in x:
                x.setdefault(on, x[name])
            if on in x:
                x.setdefault(name, x[on])
    for k, name in enumerate(n for n in task.objects if n not in x):
        x[name] = max(path.position[:, 0].max(), *x.values()) + APART * (k + 1)
    return x


def _padded(rows: np.ndarray) -> np.ndarray:
    return np.pad(rows, ((0, -len(rows) % BUCKET), (0, 0)), "edge")


def residual_summary(
    result: Replay, boundaries: Sequence[float] | np.ndarray, states: Sequence[str]
) -> dict[str, float]:
    """Root mean square of the net force residual over its noise, by contact state.

    `states` are those of the subtasks between the `boundaries` [s]; samples within 0.1 s of one
    are left out. The noise of a net force is sqrt(2) times the sensor's.
    """
    t, net = result.signals.t, result.residual.sum(axis=1) / (np.sqrt(2) * result.signals.sd_force)
    edges = np.concatenate([[t[0] - 1], boundaries, [t[-1] + 1]])
    inside = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(states) - 1)
    clear = np.abs(t[:, None] - np.asarray(boundaries)).min(axis=1) > 0.1
    out = {}
    for state in dict.fromkeys(states):
        chosen = clear & np.isin(inside, [k for k, s in enumerate(states) if s == state])
        if chosen.any():
            out[state] = float(np.sqrt(np.nanmean(net[chosen] ** 2)))
    return out
