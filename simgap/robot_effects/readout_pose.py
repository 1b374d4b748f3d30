"""A pose that one instrument reads: late as a whole, of a frame that is turned or offset from the body's.

A body's seven columns (place and unit quaternion, scalar first) come from one camera or tracker, so they are
late, turned or offset together.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, delayed
from simgap.simulators.protocol import Channels, Parameter
from simgap.simulators.recording import Recording

PLACE, TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")

WORDS = {
    "pose.lag": (
        "a pose that is read late",
        "Compare time stamps of the pose and of another channel at a sharp event.",
    ),
    "pose.turned": (
        "a tracked frame that is turned against the body's",
        "Check how the markers' frame was laid on the body.",
    ),
    "pose.offset": (
        "a tracked point beside the body's origin",
        "Measure from the tracked point to the body's origin.",
    ),
}


def candidates(setting: Setting) -> list[RobotEffect]:
    """For each body whose pose is read: its lag, and how the frame that is read lies in the body's own."""
    out = []
    for body, columns in setting.poses().items():
        place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]
        out += [_lag(body, [*place, *turn]), _turned(body, turn), _offset(body, place, turn)]
    return out


def _lag(body: str, columns: list[str]) -> RobotEffect:
    def late(window: Recording, channels: Channels, theta) -> Channels:
        since = window.t - window.t[0]
        return {n: delayed(since, channels[n], theta["delay"]) for n in columns}

    def in_time(log: Recording, theta) -> Recording:
        since = log.t - log.t[0]
        return log.with_columns({n: np.interp(since + theta["delay"], since, log[n]) for n in columns})

    delay = {"delay": Parameter(0.0, 0.01, "s", low=-0.2, high=0.5)}
    says = "recorded(t) = true(t - delay), place and orientation alike"
    return RobotEffect(f"pose:{body}.lag", says, delay, alter=late, restore=in_time)


def _turned(body: str, turn: list[str]) -> RobotEffect:
    def by(columns: Mapping[str, np.ndarray], theta, sign: float) -> dict[str, np.ndarray]:
        half = 0.5 * sign * np.array([theta["about_x"], theta["about_y"], theta["about_z"]])
        small = np.array([np.sqrt(max(1.0 - half @ half, 0.0)), *half])
        found = product(np.array([columns[n] for n in turn]), small[:, None])
        return dict(zip(turn, found, strict=True))

    angles = {f"about_{a}": Parameter(0.0, 0.01, "rad", low=-0.5, high=0.5) for a in PLACE}
    return RobotEffect(
        f"pose:{body}.turned",
        "the frame that is read is turned against the body's",
        angles,
        alter=lambda window, channels, theta: by(channels, theta, 1.0),
        restore=lambda log, theta: log.with_columns(by(log.columns, theta, -1.0)),
    )


def _offset(body: str, place: list[str], turn: list[str]) -> RobotEffect:
    def by(columns: Mapping[str, np.ndarray], theta, sign: float) -> dict[str, np.ndarray]:
        arm = sign * np.array([theta[a] for a in PLACE])
        moved = rotated(np.array([columns[n] for n in turn]), arm)
        return {n: columns[n] + d for n, d in zip(place, moved, strict=True)}

    lengths = {a: Parameter(0.0, 0.003, "m") for a in PLACE}
    return RobotEffect(
        f"pose:{body}.offset",
        "the point that is read lies beside the body's origin, fixed to the body",
        lengths,
        alter=lambda window, channels, theta: by(channels, theta, 1.0),
        restore=lambda log, theta: log.with_columns(by(log.columns, theta, -1.0)),
    )


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's product (4, n) of quaternions, scalar first."""
    w, x, y, z = a
    p, q, r, s = b
    return np.array(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ]
    )


def rotated(turn: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """A fixed arm (3,) in the body's frame, in the world's (3, n), by unit quaternions (4, n)."""
    w, axis = turn[0], turn[1:]
    once = np.cross(axis, arm[:, None], axis=0)
    return arm[:, None] + 2 * (w * once + np.cross(axis, once, axis=0))
