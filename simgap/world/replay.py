"""Replay: the finger motions of a recording drive the virtual model, which predicts forces and blocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import gammaincinv

from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import GROUND, BlockTask
from hmmseg.io.trial import Trial
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.align import segment
from simgap.world.dynamics import BUCKET, CONTROL_PERIOD, Record, interpolated
from simgap.world.properties import Blocks
from simgap.world.virtual_model import Surroundings, physics, rollout, standing, substeps_for

# Smooth finger motions from noisy samples of position and velocity.
#
# Through a foam pad, position noise of 0.02 mm makes 0.1 N, several times the force sensor's noise, so a
# replay is driven by smoothed motion. Fingers rest for seconds and stop within milliseconds at contact: each
# sample gets a local parabola, fitted to positions and velocities over the widest window (before, after or
# around it) that the data do not reject. This is Lepski's choice of bandwidth by tests (Goldenshluger &
# Nemirovski, Math. Meth. Statist. 6, 1997).

REACHES = (1, 2, 3, 4, 6, 8, 12, 16, 24)  # numerics: samples on either side
TOLERANCE = 1.2  # prior: standard deviation over the sensors', as a held finger still trembles
LEVEL = 0.1  # chosen: level of the tests that reject a window: by its residuals, and by the narrower ones


@dataclass(frozen=True)
class Motion:
    """Smoothed motion of several axes."""

    t: np.ndarray  # (T,) [s]
    position: np.ndarray  # (T, axes) [m]
    velocity: np.ndarray  # (T, axes) [m/s]
    sd: np.ndarray  # (T, axes) [m] of the position, inf where a gap was only interpolated

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (len(times), axes): cubic between samples, at rest beyond them."""
        inside = np.clip(times, self.t[0], self.t[-1])
        path = CubicHermiteSpline(self.t, self.position, self.velocity)
        return path(inside), np.where((times == inside)[:, None], path(inside, 1), 0.0)


def smooth(t: np.ndarray, position: np.ndarray, velocity: np.ndarray, sd_position: np.ndarray,
           sd_velocity: np.ndarray) -> Motion:  # fmt: skip
    """Smooth position [m] and velocity [m/s] (T, axes), NaN where missing, with noise `sd_*` of a sample."""
    weights = [np.where(np.isfinite(z), 1.0 / (TOLERANCE * sd), 0.0)
               for z, sd in ((position, sd_position), (velocity, sd_velocity))]  # fmt: skip
    samples = [np.nan_to_num(position), np.nan_to_num(velocity)]
    sides = ((1, 1), (1, 0), (0, 1))
    best, _ = _windows(t, samples, weights, 1, 1)  # position, velocity, variance of the position
    low, high = (np.full(position.shape, sign * np.inf) for sign in (-1, 1))
    growing = np.ones((len(sides), *position.shape), bool)
    for reach in REACHES:
        for k, (before, after) in enumerate(sides):
            found, fits = _windows(t, samples, weights, reach * before, reach * after)
            width = np.sqrt(found[..., 2] * 2 * gammaincinv(1 / 2, 1 - LEVEL))
            agrees = (found[..., 0] >= low) & (found[..., 0] <= high)
            growing[k] &= fits & agrees
            low = np.where(growing[k], np.maximum(low, found[..., 0] - width), low)
            high = np.where(growing[k], np.minimum(high, found[..., 0] + width), high)
            better = growing[k] & (found[..., 2] < best[..., 2])
            best[better] = found[better]
    for axis in range(best.shape[1]):  # gaps wider than any window
        there = np.isfinite(best[:, axis, 2])
        for part in (0, 1):
            best[:, axis, part] = np.interp(t, t[there], best[there, axis, part])
    return Motion(t, best[..., 0], best[..., 1], np.sqrt(best[..., 2]) / TOLERANCE)


def _windows(t: np.ndarray, samples: list[np.ndarray], weights: list[np.ndarray], before: int,
             after: int) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Fit a parabola about every sample, over the given numbers of samples before and after it. Returns
    position, velocity and variance (T, axes, 3) at the sample, and whether the data accept the window (T,
    axes). A window with one neighbour is always accepted: there is no narrower one."""
    n = t.size
    rows = np.arange(n)[:, None] + np.arange(-before, after + 1)
    inside = (rows >= 0) & (rows < n)
    rows = np.clip(rows, 0, n - 1)
    unit = np.median(np.diff(t))
    s = (t[rows] - t[:, None]) / unit
    ones, zeros = np.ones_like(s), np.zeros_like(s)
    designs = [np.stack([ones, s, s**2], -1), np.stack([zeros, ones, 2 * s], -1) / unit]
    shape = samples[0].shape
    normal, right = np.zeros((*shape, 3, 3)), np.zeros((*shape, 3))
    square, count = np.zeros(shape), np.zeros(shape)
    for design, values, weight in zip(designs, samples, weights, strict=True):
        w = (weight[rows] * inside[..., None]) ** 2  # (T, window, axes)
        y = values[rows] - (samples[0][:, None] if design is designs[0] else 0.0)
        squares = (design[..., :, None] * design[..., None, :]).reshape(*s.shape, 9)
        normal = normal + (np.swapaxes(w, 1, 2) @ squares).reshape(normal.shape)
        right = right + np.swapaxes(w * y, 1, 2) @ design
        square = square + (w * y**2).sum(1)
        count = count + (w > 0).sum(1)
    with np.errstate(invalid="ignore"):
        proper = (np.linalg.cond(normal, 1) < 1e12) & (count >= 3)
    inverse = np.linalg.inv(np.where(proper[..., None, None], normal, np.eye(3)))
    solution = (inverse @ right[..., None])[..., 0]
    left = np.maximum(square - (solution * right).sum(-1), 0.0)
    freedom = count - 3
    fits = proper & ((freedom <= 0) | (left <= 2 * gammaincinv(np.maximum(freedom, 1) / 2, 1 - LEVEL)))
    if before + after <= 2:
        fits = proper
    variance = np.where(proper, inverse[..., 0, 0], np.inf)
    return np.stack([solution[..., 0] + samples[0], solution[..., 1] / unit, variance], -1), fits


APART = 0.1  # look: m; distance between blocks that the recording never locates

# physics: mean and difference coordinates (x, y, distance, offset) from tips (x1, y1, x2, y2), and back.
TO_MEAN = np.array([[0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5], [-1, 0, 1, 0], [0, -1, 0, 1]])
TO_TIPS = np.linalg.inv(TO_MEAN)


@dataclass(frozen=True)
class Replay:
    """Predictions for one recording; T samples, 2 fingers, axes x and y last."""

    signals: Signals
    force: np.ndarray  # (T, 2, 2) [N] predicted at the samples
    measured: np.ndarray  # (T, 2, 2) [N]
    t: np.ndarray  # [s] of the rollout, at 1 kHz
    motion: Record  # the whole rollout

    @property
    def predicted(self) -> dict[str, np.ndarray]:
        """Predicted grip, net forces fx, fy and shear (T,) [N], named as in `Signals`."""
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
    """Drive the calibrated model with a recording's motion; its `boundaries` [s] place the blocks."""
    signals = task_space(trial, rig)
    if boundaries is None:
        found = segment([trial], task, rig)[0]
        boundaries = [span.start for span in found.spans[1:]]
    path = finger_motion(signals)
    t = np.arange(signals.t[0], signals.t[-1] + CONTROL_PERIOD / 2, CONTROL_PERIOD)
    position, velocity = (z @ TO_TIPS.T for z in path.at(t))
    constants = physics(rig, [blocks[name] for name in task.objects], surroundings)
    start = standing(constants, task, places(signals, path, task, np.asarray(boundaries)))
    padding = ((0, -t.size % BUCKET), (0, 0))
    moved = [jnp.asarray(np.pad(z, padding, "edge").reshape(-1, 2, 2)) for z in (position, velocity)]
    motion = rollout(constants, start, *moved, CONTROL_PERIOD, substeps_for(constants, CONTROL_PERIOD))
    motion = jax.tree.map(lambda a: np.asarray(a)[: t.size], motion)
    force = interpolated(signals.t, t, motion.force)
    measured = np.stack([getattr(signals, name) for name in FORCE_CHANNELS], 1)
    return Replay(signals, force, measured.reshape(-1, 2, 2), t, motion)


def finger_motion(signals: Signals) -> Motion:
    """Smoothed motion in x, y, distance, offset: in a grip the last two are constant while the hand moves."""
    s, scale = signals, np.sqrt([1.0, 1.0, 4.0, 4.0])  # sd_* are those of a mean; differences have twice them
    position = np.stack([s.x, s.y, s.distance, s.offset], 1)
    velocity = np.stack([s.vx, s.vy, s.vx2 - s.vx1, s.vy2 - s.vy1], 1)
    sd_position, sd_rate = (np.stack(sds * 2, 1) * scale for sds in ([s.sd_x, s.sd_y], [s.sd_vx, s.sd_vy]))
    return smooth(s.t, position, velocity, sd_position, sd_rate)


def places(signals: Signals, path: Motion, task: BlockTask, boundaries: np.ndarray) -> dict[str, float]:
    """Where every block stands initially [m]: where it is first gripped, or first built upon."""
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
    for _ in task.objects:  # the blocks of a pile stand above one another
        for name, on in task.initial.items():
            if on != GROUND and name in x:
                x.setdefault(on, x[name])
            if on in x:
                x.setdefault(name, x[on])
    for k, name in enumerate(n for n in task.objects if n not in x):
        x[name] = max(path.position[:, 0].max(), *x.values()) + APART * (k + 1)
    return x


def residual_summary(
    result: Replay, boundaries: Sequence[float] | np.ndarray, states: Sequence[str]
) -> dict[str, float]:
    """Root mean square of the net force residual over its noise, sqrt(2) times the sensor's, by contact
    state; samples within 0.1 s of a boundary [s] are left out."""
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
