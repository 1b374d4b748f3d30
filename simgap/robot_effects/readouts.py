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

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.simulators.protocol import Channels, Parameter
from simgap.simulators.recording import Recording

SHORTEST = 1e-9  # numerics: s: below this nothing is smoothed
PLACE, TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")

WORDS = {
    "readout.bias": (
        "a zero error of a reading",
        "Record two seconds at rest and compare with the model's value.",
    ),
    "readout.drift": ("a reading whose zero drifts", "Record a minute at rest after switching on."),
    "readout.gain": (
        "a reading that is off by a factor",
        "Compare the sensor with a known load or distance; check its unit and scale.",
    ),
    "readout.lag": ("a reading that comes late", "Compare time stamps of two channels at a sharp event."),
    "readout.lowpass": ("a slow filter in a reading", "Look up the filter setting of this channel."),
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
}


def candidates(setting: Setting) -> Iterator[RobotEffect]:
    """What logs have of their own; one of each kind for every channel that is read by itself; a scale where
    several lengths are read; and of each body's pose."""
    yield from by_log(setting)
    alone, late_alone = setting.alone(), setting.late_alone()
    for name in alone:
        yield RobotEffect(
            f"readout:{name}.bias", "recorded = true + bias", {"bias": setting.usual(name, 0.03)}, name,
            read=lambda since, values, theta: values + theta["bias"],
            undo=lambda since, values, theta: values - theta["bias"],
        )  # fmt: skip
    longest = max(float(r.t[-1] - r.t[0]) for r in setting.recordings)
    for name in alone:
        unit = setting.simulator.channels[name].unit
        rate = Parameter(0.0, 0.03 * setting.sd(name) / longest, f"{unit}/s")
        yield RobotEffect(
            f"readout:{name}.drift", "recorded = true + rate (t - t0)", {"rate": rate}, name,
            read=lambda since, values, theta: values + theta["rate"] * since,
            undo=lambda since, values, theta: values - theta["rate"] * since,
        )  # fmt: skip
    for name in alone:
        yield RobotEffect(
            f"readout:{name}.gain", "recorded = (1 + gain) true",
            {"gain": Parameter(0.0, 0.03, "1", low=-0.9)}, name,
            read=lambda since, values, theta: (1 + theta["gain"]) * values,
            undo=lambda since, values, theta: values / (1 + theta["gain"]),
        )  # fmt: skip
    for name in late_alone:  # a stamp that is late makes the delay negative
        yield RobotEffect(
            f"readout:{name}.lag", "recorded(t) = true(t - delay)",
            {"delay": Parameter(0.0, 0.01, "s", low=-0.2, high=0.5)}, name,
            read=lambda since, values, theta: delayed(since, values, theta["delay"]),
            undo=lambda since, values, theta: np.interp(since + theta["delay"], since, values),
        )  # fmt: skip
    for name in late_alone:
        yield RobotEffect(
            f"readout:{name}.lowpass", "time_constant recorded' + recorded = true",
            {"time_constant": Parameter(0.0, 0.01, "s", low=0.0, high=0.5)}, name,
            read=lambda since, values, theta: lowpass(since, values, theta["time_constant"]),
            undo=lambda since, values, theta: values + theta["time_constant"] * np.gradient(values, since),
        )  # fmt: skip
    for body, columns in setting.poses().items():
        place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]
        yield from (_lag(body, [*place, *turn]), _turned(body, turn), _offset(body, place, turn))
    yield from scale(setting)


def delayed(since: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Values (num_timesteps,) `delay` [s] later, at these times; before their start they were a parabola."""
    if len(values) < 3:
        return values
    late = since - delay
    slope, bend = onset(since, values)
    ahead = np.minimum(late - since[0], 0.0)
    before = values[0] + slope * ahead + 0.5 * bend * ahead**2
    return np.where(late < since[0], before, np.interp(late, since, values))


def onset(since: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """First and second derivative at the start, of the parabola through three early samples."""
    few = min(2, (len(values) - 1) // 2)
    a, b = since[few] - since[0], since[2 * few] - since[0]
    first, second = (values[few] - values[0]) / a, (values[2 * few] - values[0]) / b
    bend = 2 * (second - first) / (b - a)
    return float(first - 0.5 * bend * a), float(bend)


def lowpass(since: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """tau y' + y = u for values u (num_timesteps,) linear between samples, exactly.

    Before the start u was a parabola, which y had settled to follow: y = u - tau u' + tau^2 u''.
    """
    if time_constant < SHORTEST or len(values) < 3:
        return values
    steps = np.diff(since)
    slopes = np.diff(values) / steps
    kept = np.exp(-steps / time_constant)
    out = np.empty_like(values)
    slope, bend = onset(since, values)
    out[0] = values[0] - time_constant * slope + time_constant**2 * bend
    for i, (keep, slope) in enumerate(zip(kept, slopes, strict=True)):
        # On each piece y = u - tau slope + decaying rest.
        rest = out[i] - (values[i] - time_constant * slope)
        out[i + 1] = values[i + 1] - time_constant * slope + keep * rest
    return out


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
