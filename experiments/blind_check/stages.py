"""Stages of the recording chain that effects put in: drift, rotation, delay, play, loads, ringing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.signals import (
    Signals,
    Stage,
)

Values = dict[str, float]
Rng = np.random.Generator
FORCES, JOINTS = ("fx1", "fy1", "fx2", "fy2"), ("q11", "q12", "q21", "q22")
FINGERS = ("finger1", "finger2")


def by_channel(v: Values, name: str) -> np.ndarray:
    """A value for each of the four force channels."""
    if name in v:
        return np.full(4, v[name])
    return np.repeat(channel_values(v, FINGERS), 2) if "finger1" in v else channel_values(v, FORCES)


def added_force(shift: Callable[[Signals, Rng], np.ndarray]) -> Stage:
    return lambda s, rng: replace(s, force=s.force + shift(s, rng))


def channel_values(v: Values, names: tuple[str, ...]) -> np.ndarray:
    return np.array([v[n] for n in names])


def drift(v: Values) -> Stage:
    """Warming up: nearly straight over ten seconds, with the stated mean slope."""
    slow = 40.0

    def shift(s: Signals, rng: Rng) -> np.ndarray:
        end = s.t[-1]
        ramp = end * (1 - np.exp(-s.t / slow)) / (1 - np.exp(-end / slow))
        return ramp[:, None] * channel_values(v, FORCES)

    return added_force(shift)


def turned(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        z = (s.force[:, 0::2] + 1j * s.force[:, 1::2]) * np.exp(1j * np.array([v["angle1"], v["angle2"]]))
        return replace(s, force=np.stack([z[:, 0].real, z[:, 0].imag, z[:, 1].real, z[:, 1].imag], 1))

    return stage


def crossed(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        fx, fy = s.force[:, 0::2], s.force[:, 1::2]
        out = np.empty_like(s.force)
        out[:, 0::2], out[:, 1::2] = fx + v["fx_from_fy"] * fy, fy + v["fy_from_fx"] * fx
        return replace(s, force=out)

    return stage


def late(v: Values) -> Stage:
    delay = by_channel(v, "delay")

    def stage(s: Signals, rng: Rng) -> Signals:
        late = [np.interp(s.t - d, s.t, c) for c, d in zip(s.force.T, delay, strict=True)]
        return replace(s, force=np.stack(late, 1))

    return stage


def smooth(v: Values) -> Stage:
    constant = by_channel(v, "time_constant")

    def stage(s: Signals, rng: Rng) -> Signals:
        out = s.force.copy()
        for c, tau in enumerate(constant):
            if tau > 0:
                keep = float(np.exp(-(s.t[1] - s.t[0]) / tau))
                begin = [keep * s.force[0, c]]
                out[:, c] = lfilter([1 - keep], [1, -keep], s.force[:, c], zi=begin)[0]
        return replace(s, force=out)

    return stage


def played(v: Values) -> Stage:
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


def offset_joints(v: Values) -> Stage:
    def stage(s: Signals, rng: Rng) -> Signals:
        assert s.q is not None
        return replace(s, q=s.q + channel_values(v, JOINTS))

    return stage


def heavy(v: Values) -> Stage:
    def shift(s: Signals, rng: Rng) -> np.ndarray:
        a = np.gradient(s.motion.velocity, s.t, axis=0) + np.array([0, 1, 0, 1]) * s.rig.gravity
        keep = np.exp(-0.001 / 0.004)  # a sensor has no bandwidth for single milliseconds
        return v["mass"] * lfilter([1 - keep], [1, -keep], a, axis=0, zi=keep * a[:1])[0]

    return added_force(shift)


def pulled(v: Values) -> Stage:
    anchor = np.array([v["x0"], v["y0"]] * 2)
    return added_force(lambda s, rng: v["stiffness"] * (s.motion.position - anchor))


def ringing(v: Values) -> Stage:
    """A sensor's own mode, driven by the rate at which its load changes."""

    def stage(s: Signals, rng: Rng) -> Signals:
        w, z, dt = 2 * np.pi * v["frequency"], v["damping"], s.t[1] - s.t[0]
        pole = np.exp((-z + 1j * np.sqrt(1 - z * z)) * w * dt)
        a = [1.0, -2 * pole.real, abs(pole) ** 2]
        b = [0.0, abs(pole) * np.sin(np.angle(pole))]  # a unit step of load rings as a unit sine
        change = np.diff(s.force, axis=0, prepend=s.force[:1])
        return replace(s, force=s.force + v["coupling"] * np.asarray(lfilter(b, a, change, axis=0)))

    return stage


def bumped(v: Values) -> Stage:
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

    return added_force(shift)
