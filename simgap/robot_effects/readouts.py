"""What sensors make of the truth: a bias, a drift, a gain, a lag, a low-pass, a scale of all lengths, and a
pose that is late, turned or offset as a whole; and what every log has of its own.

A body's seven columns (place and unit quaternion, scalar first) come from one camera or tracker, so they are
late, turned or offset together. What each log has of its own is fitted along with every cause: when it was
started, where a marker sat. A simulator says so by `by_log`: `shift` (s, the log's clock against the
simulator's) and `offset` (m, of the point that is read against the body's origin, in the body's frame), each
a Parameter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from simgap.channels import ChannelEffect, channel_effects
from simgap.channels.sensors import LAG
from simgap.effect import Parameter
from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Channels
from simgap.simulators.recording import Recording

PLACE, TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")

WORDS = {
    "readout.scale": (
        "lengths that are all read too long or too short",
        "Measure a known distance with the tracking system.",
    ),
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
} | {f"readout.{n}": (e.called, e.check) for n, e in channel_effects().items()}


def candidates(setting: Setting) -> Iterator[RobotEffect]:
    """What logs have of their own; one of each kind for every channel that is read by itself; a scale where
    several lengths are read; and of each body's pose."""
    yield from by_log(setting)
    for effect in channel_effects().values():
        for name in setting.late_alone() if effect.remembers else setting.alone():
            yield of_channel(setting, name, effect)
    for body, columns in setting.poses().items():
        place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]
        yield from (_lag(body, [*place, *turn]), _turned(body, turn), _offset(body, place, turn))
    yield from scale(setting)


def of_channel(setting: Setting, name: str, effect: ChannelEffect) -> RobotEffect:
    """An effect on what is read of one channel."""
    parameters = setting.sized(effect, name)
    return RobotEffect(f"readout:{name}.{effect.name}", effect.says, parameters, effect.shows,
                       channel=name, read=effect.read, undo=effect.undo)  # fmt: skip


def scale(setting: Setting) -> list[RobotEffect]:
    """One for all lengths that are read, where there are several."""
    known = setting.simulator.channels
    names = [n for n in setting.compared("position") if known[n].unit == "m"]
    if len(names) < 2:
        return []

    def scaled(window: Recording, channels: Channels, theta) -> Channels:
        return {n: (1 + theta["scale"]) * channels[n] for n in names}

    def unscaled(log: Recording, theta) -> Recording:
        return log.with_columns({n: log[n] / (1 + theta["scale"]) for n in names})

    size = Parameter(0.0, 0.02, "1", low=-0.9)
    says = "recorded positions = (1 + scale) true ones"
    return [RobotEffect("readout.scale", says, {"scale": size}, alter=scaled, restore=unscaled)]


def _lag(body: str, columns: list[str]) -> RobotEffect:
    def late(window: Recording, channels: Channels, theta) -> Channels:
        return {n: LAG.read(window.t, channels[n], theta) for n in columns}

    def in_time(log: Recording, theta) -> Recording:
        return log.with_columns({n: LAG.undo(log.t, log[n], theta) for n in columns})

    says = f"{LAG.says}, place and orientation alike"
    return RobotEffect(f"pose:{body}.lag", says, LAG.parameters, alter=late, restore=in_time)


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


def by_log(setting: Setting) -> list[RobotEffect]:
    """One for the shift, one for each pose's offset; none is a cause."""
    known: Mapping[str, Parameter] = getattr(setting.simulator, "by_log", {})
    logs, out = [r.name for r in setting.recordings], []
    if "shift" in known:
        out.append(_log_shift(logs, known["shift"], setting.compared()))
    if "offset" in known:
        out += [_log_offset(logs, known["offset"], body, c) for body, c in setting.poses().items()]
    return out


def _log_shift(logs: list[str], one: Parameter, columns: list[str]) -> RobotEffect:
    def shifted(window: Recording, channels: Channels, theta) -> Channels:
        since = window.t - window.t[0]
        return {n: np.interp(since - theta[window.name], since, channels[n]) for n in columns}

    says = "the log was started by hand, so much before the simulator"
    return RobotEffect("log.shift", says, dict.fromkeys(logs, one), alter=shifted, fitted=True, by_log=True)


def _log_offset(logs: list[str], one: Parameter, body: str, columns: Mapping[str, str]) -> RobotEffect:
    place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]

    def moved(window: Recording, channels: Channels, theta) -> Channels:
        arm = np.array([theta[f"{window.name}.{a}"] for a in PLACE])
        by = rotated(np.array([channels[n] for n in turn]), arm)
        return {n: channels[n] + d for n, d in zip(place, by, strict=True)}

    each = {f"{log}.{a}": one for log in logs for a in PLACE}
    says = "where the marker sits on the body"
    return RobotEffect(f"log.{body}.offset", says, each, alter=moved, fitted=True, by_log=True)
