"""The recording chain: stages from the true tips to the numbers in a CSV."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from experiments.blind_check.hand import Rig, Stretch, angles, jacobians, rates, tips
from experiments.blind_check.perform import Motion

COLUMNS = ("q11", "q12", "dq11", "dq12", "fx1", "fy1", "q21", "q22", "dq21", "dq22", "fx2", "fy2")
# Stages from the fingertip to the readout; within one stage the order of the case's effects counts.
HAND, LINKS, ENCODER, MIX, SCALE, BAND, READOUT = range(7)


@dataclass(frozen=True)
class Signals:
    """Channels at 1 kHz, n rows: true motion, and what is on its way to the readout.

    `q`, `dq` (n, 4) [rad, rad/s] as the encoders have them (None until `stretch`, the true links'
    excess length, is settled), `force` (n, 4) [N].
    """

    motion: Motion
    rig: Rig
    force: np.ndarray
    stretch: Stretch = 0.0
    q: np.ndarray | None = None
    dq: np.ndarray | None = None

    @property
    def t(self) -> np.ndarray:
        """Times (n,) [s]."""
        return self.motion.t

    def with_joints(self) -> Signals:
        """The signals with joint angles computed from the true tips."""
        q = angles(self.rig, self.motion.position, self.stretch)
        return replace(self, q=q, dq=rates(self.rig, q, self.motion.velocity, self.stretch))


Stage = Callable[[Signals, np.random.Generator], Signals]


@dataclass(frozen=True)
class Sampling:
    """How the readout samples: sd [s] of the true times about the written ones (`jitter`), `step` [N] of
    forces, sizes of angle, velocity and force noise over the stated ones (`noise`), their correlation
    from sample to sample (`colour`), whether rates are the drive's backward differences of its angles.
    """

    jitter: float = 0.0
    step: float = 0.0
    noise: tuple[float, float, float] = (1.0, 1.0, 1.0)
    colour: float = 0.0
    differences: bool = False


def sense(motion: Motion, rig: Rig, stages: Sequence[tuple[int, Stage]], rng: np.random.Generator) -> Signals:
    """Apply all stages in order, without noise."""
    out = Signals(motion, rig, motion.force.copy())
    ordered = sorted(stages, key=lambda s: s[0])
    for order, stage in ordered:
        if order > LINKS and out.q is None:
            out = out.with_joints()
        out = stage(out, rng)
    return out if out.q is not None else out.with_joints()


def sample(
    signals: Signals, sampling: Sampling, rng: np.random.Generator, noisy: bool = True
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Recorded times and columns at the rig's rate; noise draws do not depend on the effects."""
    rig, t = signals.rig, signals.t
    count = int(np.floor((t[-1] - 0.01) * rig.rate)) + 1
    times = np.arange(count) / rig.rate
    shifts, noise = rng.standard_normal(count), rng.standard_normal((count, 12))
    at = np.clip(times + sampling.jitter * shifts, t[0], t[-1])
    assert signals.q is not None and signals.dq is not None
    every = np.concatenate([signals.q, signals.dq, signals.force], 1)
    values = np.stack([np.interp(at, t, c) for c in every.T], 1)
    if noisy:
        size = np.repeat(sampling.noise, 4)
        sd = size * ([rig.angle_noise] * 4 + [rig.velocity_noise] * 4 + [rig.force_noise] * 4)
        values = values + _coloured(noise, sampling.colour) * sd
    if sampling.differences:
        before = np.concatenate([values[:1, :4], values[:-1, :4]])
        values[:, 4:8] = (values[:, :4] - before) * rig.rate
    if sampling.step:
        values[:, 8:] = sampling.step * np.round(values[:, 8:] / sampling.step)
    order = [0, 1, 4, 5, 8, 9, 2, 3, 6, 7, 10, 11]
    return times, dict(zip(COLUMNS, values[:, order].T, strict=True))


def _coloured(white: np.ndarray, keep: float) -> np.ndarray:
    """White noise (n, c) turned into a stationary AR(1) of unit variance."""
    drive = np.concatenate([white[:1], np.sqrt(1 - keep**2) * white[1:]])
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def task_space(rig: Rig, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The diagnosis's channels as computed with the nominal hand."""
    q = np.stack([columns[c] for c in ("q11", "q12", "q21", "q22")], 1)
    dq = np.stack([columns[c] for c in ("dq11", "dq12", "dq21", "dq22")], 1)
    p = tips(rig, q)
    v = np.einsum("nfxj,nfj->nfx", jacobians(rig, q), dq.reshape(-1, 2, 2)).reshape(-1, 4)
    fx1, fy1, fx2, fy2 = (columns[c] for c in ("fx1", "fy1", "fx2", "fy2"))
    return {
        "x": (p[:, 0] + p[:, 2]) / 2, "y": (p[:, 1] + p[:, 3]) / 2, "distance": p[:, 2] - p[:, 0],
        "offset": p[:, 3] - p[:, 1], "vx": (v[:, 0] + v[:, 2]) / 2, "vy": (v[:, 1] + v[:, 3]) / 2,
        "fx": fx1 + fx2, "fy": fy1 + fy2, "grip": (fx1 - fx2) / 2, "shear": (fy1 - fy2) / 2,
    }  # fmt: skip


def noise_of_channels(rig: Rig, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Standard deviations (n,) of one sample of every task-space channel from the rig's noise."""
    q = np.stack([columns[c] for c in ("q11", "q12", "q21", "q22")], 1)
    size = np.sqrt((jacobians(rig, q) ** 2).sum(3))  # (n, finger, axis): m/rad
    both = np.hypot(size[:, 0], size[:, 1])
    a, v, f = rig.angle_noise, rig.velocity_noise, np.full(len(q), rig.force_noise)
    return {
        "x": a * both[:, 0] / 2, "y": a * both[:, 1] / 2, "distance": a * both[:, 0],
        "offset": a * both[:, 1], "vx": v * both[:, 0] / 2, "vy": v * both[:, 1] / 2, "fx": f * np.sqrt(2),
        "fy": f * np.sqrt(2), "grip": f / np.sqrt(2), "shear": f / np.sqrt(2),
    }  # fmt: skip


# Stages that effects put in: drift, rotation, delay, play, loads, ringing.

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
