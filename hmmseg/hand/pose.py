"""Pose of a parallel gripper's tool from its recorded channels, smoothed motion included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.gripper import AXES, Gripper, direction
from hmmseg.io.trial import Trial
from hmmseg.robust import bridged, white_sd

WINDOW, WIDEST = 0.1, 0.4  # chosen: s over which motion is smoothed: arms change no faster
LEAST = 3  # numerics: samples of the same: what a parabola needs
QUIET = 0.1  # chosen: m/s^2; the window widens until the acceleration's noise is less: a hundredth of gravity


@dataclass(frozen=True)
class Pose:
    """Motion of the pads' middle in the world at t (num_timesteps,) [s].

    `position`, `velocity`, `acceleration` (num_timesteps, 3) [m, m/s, m/s^2], the latter two smoothed
    over `window` [s]; `turned` (num_timesteps, 3, 3): from the
    tool's axes to the world's; `up`, `across` (3,): unit vectors against gravity and, horizontally,
    along the closing.
    """

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    turned: np.ndarray
    up: np.ndarray
    across: np.ndarray
    window: float


def pose_of(trial: Trial, gripper: Gripper, window: float | None = None) -> Pose:
    """Pose in every sample, gaps bridged; InputError where it cannot be had.

    `window` [s]: over which to smooth; as wide as the noise wants where it is not given.
    """
    t, n = trial.t, trial.t.size
    position = np.zeros((n, 3))
    for axis, name in gripper.position.items():
        position[:, AXES.index(axis)] = bridged(trial.channels[name], t)
    turned = _turned(trial, gripper)
    position = position + np.einsum("tij,j->ti", turned, np.asarray(gripper.fingertip))
    up = direction(gripper.up)
    across = (turned @ np.eye(3)[AXES.index(gripper.closing)]).mean(axis=0)
    across -= up * (across @ up)
    if np.linalg.norm(across) < 0.5:
        where = f"{trial.file}: [gripper] closing"
        problem = f"the pads close along {gripper.closing}, which is mostly up and down"
        raise InputError(where, problem, "the axis along which they close, and a quaternion x, y, z, w")
    window = _window(t, position) if window is None else window
    velocity, acceleration = (smooth(t, position, deriv, window) for deriv in (1, 2))
    return Pose(t, position, velocity, acceleration, turned, up, across / np.linalg.norm(across), window)


def _window(t: np.ndarray, position: np.ndarray) -> float:
    """Smoothing window [s] that leaves little noise in the acceleration.

    Of a parabola through n samples, the second derivative's variance is 720 s^2 / (n^5 dt^4) for large n.
    """
    period = float(np.median(np.diff(t)))
    sd = max(white_sd(c) for c in position.T)
    needed = (720 * sd**2 / period**4 / QUIET**2) ** 0.2 * period
    return float(np.clip(needed, WINDOW, WIDEST))


def _turned(trial: Trial, gripper: Gripper) -> np.ndarray:
    from scipy.spatial.transform import Rotation  # slow to import

    t = trial.t
    if gripper.quaternion is not None:
        q = np.stack([trial.channels[name] for name in gripper.quaternion], axis=1)
        norm = np.linalg.norm(q, axis=1)
        there = np.isfinite(norm)
        if not (np.abs(norm[there] - 1) < 0.05).all():
            row = int(np.flatnonzero(there & ~(np.abs(norm - 1) < 0.05))[0])
            where = f"{trial.file}: row {row + 2}: columns {', '.join(gripper.quaternion)}"
            raise InputError(where, f"a quaternion of norm {norm[row]:.3g}", "a norm of 1 (x, y, z, w)")
        if not there.any():
            raise InputError(f"{trial.file}: column {gripper.quaternion[0]}", "has no complete quaternion")
        signs = np.cumprod(np.r_[1.0, np.where((q[there][1:] * q[there][:-1]).sum(axis=1) < 0, -1, 1)])
        q[there] *= signs[:, None]  # q and -q turn alike: no jumps between them
        q[~there] = np.nan
        return Rotation.from_quat(np.stack([bridged(c, t) for c in q.T], axis=1)).as_matrix()
    if gripper.rotation_vector is not None:
        names = gripper.rotation_vector
        vectors = np.stack([trial.channels[name] for name in names], axis=1)
        there = np.isfinite(vectors).all(axis=1)
        if not there.any():
            raise InputError(f"{trial.file}: column {names[0]}", "has no complete rotation vector")
        if np.linalg.norm(vectors[there], axis=1).max() > 4 * np.pi:
            where = f"{trial.file}: columns {', '.join(names)}"
            problem = "rotation vectors of more than two turns: they look like degrees"
            remedy = f'{names[0]} = {{unit = "deg"}} and the like under [columns] in rig.toml'
            raise InputError(where, problem, remedy)
        nearest = np.round(np.interp(t, t[there], np.arange(there.sum()))).astype(int)
        return Rotation.from_rotvec(vectors[there][nearest]).as_matrix()
    return np.broadcast_to(np.eye(3), (t.size, 3, 3))


def smooth(t: np.ndarray, values: np.ndarray, deriv: int = 0, window: float = WINDOW) -> np.ndarray:
    """Local parabolas through values (num_timesteps, ...) over `window` s, or their derivative.

    Savitzky and Golay 1964, Anal. Chem. 36; samples that are not evenly spaced are read as if on the
    even grid of as many.
    """
    flat = values.reshape(len(t), -1)
    even = np.linspace(t[0], t[-1], len(t))
    period = float(even[1] - even[0])
    length = max(LEAST, round(window / period) // 2 * 2 + 1)
    length = min(length, (len(t) - 1) // 2 * 2 + 1)
    gridded = np.stack([np.interp(even, t, column) for column in flat.T], axis=1)
    found = np.stack([_parabolas(column, length, deriv) for column in gridded.T], axis=1) / period**deriv
    out = np.stack([np.interp(t, even, column) for column in found.T], axis=1)
    return out.reshape(values.shape)


def _parabolas(values: np.ndarray, length: int, deriv: int) -> np.ndarray:
    """Values (N,), or their derivative a step, of parabolas through `length` (odd) of them about each.

    The first and the last half of `length` are on the first and the last parabola. As
    scipy.signal.savgol_filter, whose import takes longer than most recordings.
    """
    half = length // 2
    steps = np.vander(np.arange(-half, half + 1), 3, increasing=True)
    fit = np.linalg.pinv(steps)
    slopes = [steps, np.pad(steps[:, :2], ((0, 0), (1, 0))) * (0, 1, 2), np.eye(3)[[2] * length] * 2]
    middle = np.convolve(values, (slopes[deriv][half] @ fit)[::-1], mode="valid")
    first, last = (slopes[deriv] @ (fit @ end) for end in (values[:length], values[-length:]))
    return np.concatenate([first[:half], middle, last[half + 1 :]])
