"""Effects on read-outs: bias, drift, gain, lag and low-pass of a channel, a scale of all lengths, and a pose
that is late, rotated or offset as a whole; and what differs between logs.

A body's seven columns (place and unit quaternion, scalar first) come from one camera or tracker, so they are
late, rotated or offset together. What differs between logs is fitted along with every cause: when a log was
started, where a marker sat. A simulator declares it by `by_log`: `shift` [s], the log's clock against the
simulator's, and `offset` [m], of the point that is read from the body's origin, in the body's frame, each a
Parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from simgap.channels import Act, ChannelEffect, Theta, channel_effects
from simgap.channels.sensors import LAG
from simgap.effect import Parameter
from simgap.robot_effects.base import Alter, RobotEffect, Setting
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
        "a tracked point off the body's origin",
        "Measure from the tracked point to the body's origin.",
    ),
} | {f"readout.{n}": (e.called, e.check) for n, e in channel_effects().items()}


def candidates(setting: Setting) -> Iterator[RobotEffect]:
    """What differs between logs; one of each kind for every channel that is read by itself; a scale where
    several lengths are read; and those of each body's pose."""
    yield from by_log(setting)
    for effect in channel_effects().values():
        for name in setting.late_alone() if effect.remembers else setting.alone():
            yield of_channel(setting, name, effect)
    for body, columns in setting.poses().items():
        yield from of_pose(body, columns)
    known = setting.simulator.channels
    lengths = [n for n in setting.compared("position") if known[n].unit == "m"]
    if len(lengths) > 1:
        yield _of_columns(
            "readout.scale", "recorded positions = (1 + scale) true ones",
            {"scale": Parameter(0.0, 0.02, "1", low=-0.9)},
            lambda t, columns, theta, way: {n: (1 + theta["scale"]) ** way * columns[n] for n in lengths},
        )  # fmt: skip


def of_channel(setting: Setting, name: str, effect: ChannelEffect) -> RobotEffect:
    """An effect on the read-out of one channel."""
    begun = {r.name: float(r.t[0]) for r in setting.recordings}

    def acting(act: Act, log: Recording, values: np.ndarray, theta: Theta) -> dict[str, np.ndarray]:
        return {name: _where_seen(act, log.t - begun.get(log.name, log.t[0]), values, theta)}

    def restore(log: Recording, theta: Theta) -> Recording:
        assert effect.undo is not None
        return log.with_columns(acting(effect.undo, log, log[name], theta))

    return RobotEffect(
        f"readout:{name}.{effect.name}", effect.says, setting.sized(effect, name), effect.shows,
        alter=lambda window, channels, theta: acting(effect.read, window, channels[name], theta),
        restore=None if effect.undo is None else restore,
    )  # fmt: skip


def _where_seen(act: Act, t: np.ndarray, values: np.ndarray, theta: Theta) -> np.ndarray:
    """What acts from sample to sample, from those to those that are there."""
    out, seen = np.array(values), np.isfinite(values)
    if seen.sum() > 1:
        out[seen] = act(t[seen], values[seen], theta)
    return out


Turn = Callable[[np.ndarray, Channels, Theta, float], Channels]  # (times, columns, theta, 1 there or -1 back)


def _of_columns(name: str, says: str, parameters: Mapping[str, Parameter], act: Turn) -> RobotEffect:
    """An effect on several columns at once, with its inverse."""
    return RobotEffect(
        name,
        says,
        parameters,
        alter=lambda window, channels, theta: act(window.t, channels, theta, 1.0),
        restore=lambda log, theta: log.with_columns(act(log.t, log.columns, theta, -1.0)),
    )


def of_pose(body: str, columns: Mapping[str, str]) -> Iterator[RobotEffect]:
    """Effects on a body's pose as a whole."""
    place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]

    def late(t: np.ndarray, known: Channels, theta: Theta, way: float) -> Channels:
        read = LAG.read if way > 0 else LAG.undo
        assert read is not None
        return {n: _where_seen(read, t, known[n], theta) for n in (*place, *turn)}

    def turned(t: np.ndarray, known: Channels, theta: Theta, way: float) -> Channels:
        half = 0.5 * way * np.array([theta[f"about_{a}"] for a in PLACE])
        small = np.array([np.sqrt(max(1.0 - float(half @ half), 0.0)), *half])
        found = product(np.array([known[n] for n in turn]), small[:, None])
        return dict(zip(turn, found, strict=True))

    def offset(t: np.ndarray, known: Channels, theta: Theta, way: float) -> Channels:
        return _shifted(known, place, turn, way * np.array([theta[a] for a in PLACE]))

    yield _of_columns(f"pose:{body}.lag", f"{LAG.says}, place and orientation alike", LAG.parameters, late)
    angles = {f"about_{a}": Parameter(0.0, 0.01, "rad", low=-0.5, high=0.5) for a in PLACE}
    yield _of_columns(
        f"pose:{body}.turned", "the frame that is read is turned against the body's", angles, turned
    )
    says = "the point that is read is off the body's origin, fixed to the body"
    yield _of_columns(f"pose:{body}.offset", says, {a: Parameter(0.0, 0.003, "m") for a in PLACE}, offset)


def _shifted(columns: Channels, place: Sequence[str], turn: Sequence[str], arm: np.ndarray) -> Channels:
    """Places of a point offset by `arm` (3,) in the body's frame from that of `columns`."""
    moved = rotated(np.array([columns[n] for n in turn]), arm)
    return {n: columns[n] + d for n, d in zip(place, moved, strict=True)}


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The Hamilton product (4, n) of quaternions, scalar first."""
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
    """A fixed arm (3,) in the body's frame, rotated to the world's (3, n) by unit quaternions (4, n)."""
    w, axis = turn[0], turn[1:]
    once = np.cross(axis, arm[:, None], axis=0)
    return arm[:, None] + 2 * (w * once + np.cross(axis, once, axis=0))


def by_log(setting: Setting) -> Iterator[RobotEffect]:
    """The shift of each log, and the offset of each pose; none is a cause."""
    known: Mapping[str, Parameter] = getattr(setting.simulator, "by_log", {})
    logs, every = [r.name for r in setting.recordings], setting.compared()

    def of_log(name: str, says: str, each: Mapping[str, Parameter], alter: Alter) -> RobotEffect:
        return RobotEffect(name, says, each, alter=alter, fitted=True, by_log=True)

    def late(window: Recording, channels: Channels, theta: Theta) -> Channels:
        since = window.t - window.t[0]
        return {n: np.interp(since - theta[window.name], since, channels[n]) for n in every}

    if "shift" in known:
        says = "the log was started by hand, so much before the simulator"
        yield of_log("log.shift", says, dict.fromkeys(logs, known["shift"]), late)
    for body, columns in setting.poses().items() if "offset" in known else ():

        def moved(
            window: Recording, channels: Channels, theta: Theta, columns: Mapping[str, str] = columns
        ) -> Channels:
            arm = np.array([theta[f"{window.name}.{a}"] for a in PLACE])
            return _shifted(channels, [columns[a] for a in PLACE], [columns[a] for a in TURN], arm)

        each = {f"{log}.{a}": known["offset"] for log in logs for a in PLACE}
        yield of_log(f"log.{body}.offset", "where the marker sits on the body", each, moved)
