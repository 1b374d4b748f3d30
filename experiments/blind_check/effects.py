"""The contract's effects, put in by MuJoCo's own means or in the recording chain, in forms of their own.

Every entry draws its parameters at a size (1: large) and says what it changes: the world before the
run, stages of the recording chain, the readout's sampling. Parameters are those of the contract.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.hand import Rig
from experiments.blind_check.scene import World
from experiments.blind_check.signals import (
    BAND,
    ENCODER,
    HAND,
    LINKS,
    MIX,
    READOUT,
    SCALE,
    Signals,
    Stage,
)

Values = dict[str, float]
Rng = np.random.Generator
FORCES, JOINTS = ("fx1", "fy1", "fx2", "fy2"), ("q11", "q12", "q21", "q22")


@dataclass(frozen=True)
class Change:
    """What one effect does: `world` edits the world, `stages` the chain, `sampling` the readout."""

    world: Callable[[World], World] | None = None
    stages: tuple[tuple[int, Stage], ...] = ()
    sampling: dict[str, float] = field(default_factory=dict)
    style: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Made:
    """An effect of the check: `draw(rng, size)` gives the contract's parameters and hidden details."""

    name: str
    draw: Callable[[Rng, float], Values]
    change: Callable[[Values], Change]
    scored: bool = True  # whether its parameters mean what the contract's mean


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _some(rng: Rng, names: tuple[str, ...], unit: float) -> Values:
    """Channels of random sign and size, some of them spared, at rms `unit`."""
    while True:
        x = rng.normal(size=len(names)) * (rng.random(len(names)) < 0.7)
        if np.abs(x).max() > 0.2:
            return dict(zip(names, map(float, unit * x / np.sqrt((x**2).mean())), strict=True))


FINGERS = ("finger1", "finger2")
GROSS = 0.12  # share of biases that are a sensor never tared
TARE = 1.0  # N


def _bias(rng: Rng, size: float) -> Values:
    """Four channels' zeros, or one sensor that was never tared."""
    if size > 0.3 and rng.random() < GROSS:
        return dict.fromkeys(FORCES, 0.0) | {str(rng.choice(FORCES)): TARE * _sign(rng) * rng.uniform(0.5, 2)}
    return _some(rng, FORCES, 0.16 * size)


def _common_or_one(rng: Rng, name: str, value: float, channels: bool = False) -> Values:
    """Of both fingers alike, as `name`, or of one finger or channel alone."""
    kind = rng.random()
    if kind < 0.6:
        return {name: value}
    names = FORCES if channels and kind > 0.85 else FINGERS
    return dict.fromkeys(names, 0.0) | {str(rng.choice(names)): value}


def _by_channel(v: Values, name: str) -> np.ndarray:
    """A value for each of the four force channels."""
    if name in v:
        return np.full(4, v[name])
    return np.repeat(_row(v, FINGERS), 2) if "finger1" in v else _row(v, FORCES)


def _force(shift: Callable[[Signals, Rng], np.ndarray]) -> Stage:
    return lambda s, rng: replace(s, force=s.force + shift(s, rng))


def _row(v: Values, names: tuple[str, ...]) -> np.ndarray:
    return np.array([v[n] for n in names])


def _drift(v: Values) -> Stage:
    """Warming up: nearly straight over ten seconds, with the stated mean slope."""
    slow = 40.0

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        end = s.t[-1]
        ramp = end * (1 - np.exp(-s.t / slow)) / (1 - np.exp(-end / slow))
        return ramp[:, None] * _row(v, FORCES)

    return _force(shift)


def _turned(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        z = (s.force[:, 0::2] + 1j * s.force[:, 1::2]) * np.exp(1j * np.array([v["angle1"], v["angle2"]]))
        return replace(s, force=np.stack([z[:, 0].real, z[:, 0].imag, z[:, 1].real, z[:, 1].imag], 1))

    return stage


def _crossed(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        fx, fy = s.force[:, 0::2], s.force[:, 1::2]
        out = np.empty_like(s.force)
        out[:, 0::2], out[:, 1::2] = fx + v["fx_from_fy"] * fy, fy + v["fy_from_fx"] * fx
        return replace(s, force=out)

    return stage


def _late(v: Values) -> Stage:
    delay = _by_channel(v, "delay")

    def stage(s: Signals, rng: Rng) -> Signals:
        late = [np.interp(s.t - d, s.t, c) for c, d in zip(s.force.T, delay, strict=True)]
        return replace(s, force=np.stack(late, 1))

    return stage


def _smooth(v: Values) -> Stage:
    constant = _by_channel(v, "time_constant")

    def stage(s: Signals, rng: Rng) -> Signals:
        out = s.force.copy()
        for c, tau in enumerate(constant):
            if tau > 0:
                keep = float(np.exp(-(s.t[1] - s.t[0]) / tau))
                begin = [keep * s.force[0, c]]
                out[:, c] = lfilter([1 - keep], [1, -keep], s.force[:, c], zi=begin)[0]
        return replace(s, force=out)

    return stage


def _played(v: Values) -> Stage:
    """Gear play: the encoder is dragged along only when the joint has crossed the dead band."""

    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None and s.dq is not None
        half = v["width"] / 2
        out, rate = s.q.copy(), s.dq.copy()
        held = s.q[0] + rng.uniform(-half, half, 4)
        for k, row in enumerate(s.q):
            new = np.minimum(np.maximum(held, row - half), row + half)
            rate[k] = np.where(new == held, 0.0, rate[k])
            out[k] = held = new
        return replace(s, q=out, dq=rate)

    return stage


def _offset_joints(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        return replace(s, q=s.q + _row(v, JOINTS))

    return stage


def _heavy(v: Values) -> Stage:
    def shift(s: Signals, rng: Rng) -> np.ndarray:
        a = np.gradient(s.motion.velocity, s.t, axis=0) + np.array([0, 1, 0, 1]) * s.rig.gravity
        keep = np.exp(-0.001 / 0.004)  # a sensor has no bandwidth for single milliseconds
        return v["mass"] * lfilter([1 - keep], [1, -keep], a, axis=0, zi=keep * a[:1])[0]

    return _force(shift)


def _pulled(v: Values) -> Stage:
    anchor = np.array([v["x0"], v["y0"]] * 2)
    return _force(lambda s, rng: v["stiffness"] * (s.motion.position - anchor))


def _ringing(v: Values) -> Stage:
    """A sensor's own mode, driven by the rate at which its load changes."""

    def stage(s: Signals, rng: Rng) -> Signals:
        w, z, dt = 2 * np.pi * v["frequency"], v["damping"], s.t[1] - s.t[0]
        pole = np.exp((-z + 1j * np.sqrt(1 - z * z)) * w * dt)
        a = [1.0, -2 * pole.real, abs(pole) ** 2]
        b = [0.0, abs(pole) * np.sin(np.angle(pole))]  # a unit step of load rings as a unit sine
        change = np.diff(s.force, axis=0, prepend=s.force[:1])
        return replace(s, force=s.force + v["coupling"] * np.asarray(lfilter(b, a, change, axis=0)))

    return stage


def _bumped(v: Values) -> Stage:
    """A half sine of the stated impulse (per cent of scatter) at every touchdown, shared by the fingers."""

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        out = np.zeros_like(s.force)
        for at in s.motion.boundaries[2::4]:
            width, share = v["length"], rng.uniform(0.35, 0.65)
            phase = np.clip((s.t - at) / width, 0, 1)
            pulse = -v["impulse"] * np.pi / (2 * width) * np.sin(np.pi * phase) * rng.normal(1, 0.05)
            out[:, 1] += share * pulse
            out[:, 3] += (1 - share) * pulse
        return out

    return _force(shift)


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _pads(rng: Rng, size: float) -> Values:
    """Stiffer or softer by up to a factor 3.5; in shear alike, or not at all. Shares of the rig's own."""
    way = _sign(rng) if size > 0.3 else -1.0
    scale = float(np.exp(way * 1.25 * size))
    return {
        "normal_stiffness": scale,
        "shear_stiffness": float(rng.choice([1.0, scale])),
        "exponent": float(rng.choice([1.0, 1.08])),
    }


def fitted(name: str, values: Values, rig: Rig) -> Values:
    """Values drawn for the nominal rig, as they are on another: pads as stiffnesses, times by its rate."""
    out = dict(values)
    if name == "fingertip_compliance":
        out["normal_stiffness"] *= rig.normal_stiffness
        out["shear_stiffness"] *= rig.shear_stiffness
    if name == "clock_jitter":
        out["sd"] *= min(1.0, 20.0 / rig.rate)
    return out


def _misjudged(rng: Rng, size: float) -> Values:
    """A property of block1 that was measured wrong, by a share of it."""
    return {f"block1.{rng.choice(['weight', 'width', 'height'])}": 0.15 * size * _sign(rng)}


def _world(**names: str) -> Callable[[Values], Change]:
    """A change of the world's fields: field = parameter."""
    return lambda v: Change(world=lambda w: replace(w, **{f: v[p] for f, p in names.items()}))


MADE = (
    Made(
        "force_bias",
        _bias,
        lambda v: Change(stages=((READOUT, _force(lambda s, r: _row(v, FORCES))),)),
    ),
    Made(
        "force_drift",
        lambda r, s: _some(r, FORCES, 0.025 * s),
        lambda v: Change(stages=((READOUT, _drift(v)),)),
    ),
    Made(
        "force_gain",
        lambda r, s: _common_or_one(r, "gain", 0.16 * s * _sign(r), channels=True),
        lambda v: Change(
            stages=((SCALE, lambda s, r: replace(s, force=s.force * (1 + _by_channel(v, "gain")))),)
        ),
    ),
    Made(
        "force_crosstalk",
        lambda r, s: {
            "fy_from_fx": 0.09 * s * _sign(r),
            "fx_from_fy": 0.09 * s * r.uniform(-1, 1),
        },
        lambda v: Change(stages=((MIX, _crossed(v)),)),
    ),
    Made(
        "sensor_rotation",
        lambda r, s: {"angle1": 0.1 * s * _sign(r) * r.uniform(0.5, 1), "angle2": 0.1 * s * _sign(r)},
        lambda v: Change(stages=((MIX, _turned(v)),)),
    ),
    Made(
        "force_lag",
        lambda r, s: _common_or_one(r, "delay", 0.25 * s),
        lambda v: Change(stages=((BAND, _late(v)),)),
    ),
    Made(
        "force_lowpass",
        lambda r, s: _common_or_one(r, "time_constant", 0.2 * s),
        lambda v: Change(stages=((BAND, _smooth(v)),)),
    ),
    Made("quantisation", lambda r, s: {"step": 0.2 * s}, lambda v: Change(sampling={"step": v["step"]})),
    Made(
        "joint_offset",
        lambda r, s: _some(r, JOINTS, 0.02 * s),
        lambda v: Change(stages=((ENCODER, _offset_joints(v)),)),
    ),
    Made(
        "link_length",
        lambda r, s: {"scale": 0.04 * s * _sign(r)},
        lambda v: Change(stages=((LINKS, lambda s, r: replace(s, stretch=s.stretch + v["scale"])),)),
    ),
    Made("backlash", lambda r, s: {"width": 0.012 * s}, lambda v: Change(stages=((ENCODER, _played(v)),))),
    Made("clock_jitter", lambda r, s: {"sd": 0.02 * s}, lambda v: Change(sampling={"jitter": v["sd"]})),
    Made(
        "fingertip_compliance",
        _pads,
        _world(normal_stiffness="normal_stiffness", shear_stiffness="shear_stiffness", exponent="exponent"),
    ),
    Made(
        "fingertip_creep",
        lambda r, s: {"ratio": 1.2 * s, "time_constant": _log(r, 0.2, 2.0)},
        _world(creep_ratio="ratio", creep_time="time_constant"),
    ),
    Made("fingertip_mass", lambda r, s: {"mass": 0.03 * s}, lambda v: Change(stages=((HAND, _heavy(v)),))),
    Made(
        "grip_slip",
        lambda r, s: {"mu": 0.22 + 0.13 * (1 - s) * r.uniform(0.6, 1.4)},
        lambda v: Change(
            world=lambda w: replace(w, pad_friction=v["mu"]),
            style={"grip": (1.3, 1.9), "press": (0.8, 1.6)},
        ),
    ),
    Made(
        "offcentre_mass",
        lambda r, s: {"offset": 0.005 * s * _sign(r)},
        _world(mass_offset="offset"),
        scored=False,  # a hand that yields under the heavier side and a grip that then pushes askew add to it
    ),
    Made(
        "hand_roll",
        lambda r, s: {"amplitude": 0.02 * s},
        lambda v: Change(style={"roll": v["amplitude"]}),
    ),
    Made("actual", _misjudged, lambda v: Change()),
    Made("table_tilt", lambda r, s: {"angle": 0.04 * s * _sign(r)}, _world(tilt="angle")),
    Made(
        "table_compliance",
        lambda r, s: {"stiffness": 700.0 / s},
        _world(table_stiffness="stiffness"),
    ),
    Made(
        "cable_force",
        lambda r, s: {
            "stiffness": 4.0 * s * _sign(r),
            "x0": r.uniform(0.08, 0.2),
            "y0": r.uniform(-0.02, 0.1),
        },
        lambda v: Change(
            world=lambda w: replace(w, cable=(v["stiffness"], v["x0"], v["y0"])),
            stages=((HAND, _pulled(v)),),
        ),
    ),
    Made(
        "viscous_drag",
        lambda r, s: {"coefficient": 1.8 * s},
        lambda v: Change(
            world=lambda w: replace(w, drag=v["coefficient"]),
            stages=((HAND, _force(lambda s, r: v["coefficient"] * s.motion.velocity)),),
        ),
    ),
    Made(
        "structural_vibration",
        lambda r, s: {
            "frequency": r.uniform(2.5, 14.0),
            "damping": _log(r, 0.015, 0.12),
            "coupling": 0.3 * s,
        },
        lambda v: Change(stages=((MIX, _ringing(v)),)),
    ),
    Made(
        "contact_impact",
        lambda r, s: {"impulse": 0.08 * s, "length": _log(r, 0.03, 0.08)},
        lambda v: Change(stages=((HAND, _bumped(v)),)),
    ),
)
CATALOGUE = {made.name: made for made in MADE}
