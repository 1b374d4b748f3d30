"""Kinematics of the nominal hand: two planar two-link fingers with absolute link angles.

tip = base + L1 (cos q1, sin q1) + L2 (cos q2, sin q2), per finger; the tip frame never rotates.
Functions take NumPy arrays to NumPy arrays and JAX arrays to JAX arrays, so that effects on angles or links
can be differentiated while recordings need no compilation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import Finger

Array = Any  # np.ndarray or jax.Array
ELBOW = {1: -1.0, 2: 1.0}  # physics: sign of the turn from the line base-tip to link 1: elbows point outwards


def forward(finger: Finger, q: Array) -> Array:
    """Tip positions (..., 2) [m] from link angles (..., 2) [rad]."""
    xp, (first, second) = _module(q), finger.links
    x = finger.base[0] + first * xp.cos(q[..., 0]) + second * xp.cos(q[..., 1])
    y = finger.base[1] + first * xp.sin(q[..., 0]) + second * xp.sin(q[..., 1])
    return xp.stack([x, y], -1)


def turning(length: Array, q: Array) -> tuple[Array, Array]:
    """Derivatives of each link's far end by its angle q (..., links) [rad]: x and y (..., links) [m/rad].

    Rotated by -90 degrees, (y, -x), it is the link itself.
    """
    xp = _module(q)
    return -length * xp.sin(q), length * xp.cos(q)


def jacobian(finger: Finger, q: Array) -> Array:
    """Derivatives (..., 2 axes, 2 links) [m/rad] of the tip by the link angles (..., 2) [rad]."""
    return _module(q).stack(turning(np.asarray(finger.links), q), -2)


def tip_velocity(finger: Finger, q: Array, rate: Array) -> Array:
    """Tip velocities (..., 2) [m/s] from link angles [rad] and their rates (..., 2) [rad/s]."""
    return (jacobian(finger, q) * rate[..., None, :]).sum(-1)


def inverse(finger: Finger, number: int, tip: Array) -> Array:
    """Link angles (..., 2) [rad] that bring finger `number` (1 or 2) to `tip` (..., 2) [m].

    By the law of cosines, elbows outwards; angles vary continuously over the reach. NaN where the
    tip is out of reach (see `require_reach`).
    """
    xp, (first, second) = _module(tip), finger.links
    across, up = tip[..., 0] - finger.base[0], tip[..., 1] - finger.base[1]
    distance, direction = xp.hypot(across, up), xp.arctan2(up, across)
    inner = xp.arccos((distance**2 + first**2 - second**2) / (2 * distance * first))
    outer = xp.arccos((distance**2 + second**2 - first**2) / (2 * distance * second))
    return xp.stack([direction + ELBOW[number] * inner, direction - ELBOW[number] * outer], -1)


def joint_velocity(finger: Finger, q: Array, velocity: Array) -> Array:
    """Rates (..., 2) [rad/s] of the link angles q that move the tip at `velocity` (..., 2) [m/s].

    The inverse of the Jacobian [-L1 sin q1, -L2 sin q2; L1 cos q1, L2 cos q2] by Cramer's rule.
    """
    xp, (first, second) = _module(q), finger.links
    vx, vy = velocity[..., 0], velocity[..., 1]
    turn = xp.sin(q[..., 1] - q[..., 0])
    one = (xp.cos(q[..., 1]) * vx + xp.sin(q[..., 1]) * vy) / (first * turn)
    two = -(xp.cos(q[..., 0]) * vx + xp.sin(q[..., 0]) * vy) / (second * turn)
    return xp.stack([one, two], -1)


def require_reach(finger: Finger, number: int, tip: np.ndarray) -> None:
    """InputError if a motion `tip` (..., 2) [m] leaves the reach of finger `number`."""
    distance = np.hypot(*np.moveaxis(np.asarray(tip) - finger.base, -1, 0))
    nearest, farthest = abs(finger.links[0] - finger.links[1]), sum(finger.links)
    if distance.max() >= farthest or distance.min() <= nearest:
        raise InputError(f"finger {number}", f"the task needs a tip {distance.max():.3f} m from its base",
                         f"between {nearest:.3f} and {farthest:.3f} m, the reach of its links")  # fmt: skip


def _module(array: Array) -> Any:
    if isinstance(array, np.ndarray):
        return np
    import jax.numpy as jnp  # whoever has such an array has loaded it

    return jnp
