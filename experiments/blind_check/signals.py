"""What the sensors make of a motion: a chain of stages from the true tips to the numbers in a CSV."""

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
        """Angles settled from the true tips."""
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
    """All stages in order, without noise."""
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
    """Written times and columns at the rig's rate; noise is drawn alike whatever the effects are."""
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
    """White noise (n, c) made a stationary AR(1) of unit size."""
    drive = np.concatenate([white[:1], np.sqrt(1 - keep**2) * white[1:]])
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def task_space(rig: Rig, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Channels that a diagnosis speaks of, as the nominal hand has them."""
    q = np.stack([columns[c] for c in ("q11", "q12", "q21", "q22")], 1)
    dq = np.stack([columns[c] for c in ("dq11", "dq12", "dq21", "dq22")], 1)
    p = tips(rig, q)
    v = np.einsum("nfxj,nfj->nfx", jacobians(rig, q), dq.reshape(-1, 2, 2)).reshape(-1, 4)
    fx1, fy1, fx2, fy2 = (columns[c] for c in ("fx1", "fy1", "fx2", "fy2"))
    return {
        "x": (p[:, 0] + p[:, 2]) / 2,
        "y": (p[:, 1] + p[:, 3]) / 2,
        "distance": p[:, 2] - p[:, 0],
        "offset": p[:, 3] - p[:, 1],
        "vx": (v[:, 0] + v[:, 2]) / 2,
        "vy": (v[:, 1] + v[:, 3]) / 2,
        "fx": fx1 + fx2,
        "fy": fy1 + fy2,
        "grip": (fx1 - fx2) / 2,
        "shear": (fy1 - fy2) / 2,
    }


def noise_of_channels(rig: Rig, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Standard deviations (n,) of one sample of every task-space channel from the rig's noise."""
    q = np.stack([columns[c] for c in ("q11", "q12", "q21", "q22")], 1)
    size = np.sqrt((jacobians(rig, q) ** 2).sum(3))  # (n, finger, axis): m/rad
    both = np.hypot(size[:, 0], size[:, 1])
    a, v, f = rig.angle_noise, rig.velocity_noise, np.full(len(q), rig.force_noise)
    return {
        "x": a * both[:, 0] / 2,
        "y": a * both[:, 1] / 2,
        "distance": a * both[:, 0],
        "offset": a * both[:, 1],
        "vx": v * both[:, 0] / 2,
        "vy": v * both[:, 1] / 2,
        "fx": f * np.sqrt(2),
        "fy": f * np.sqrt(2),
        "grip": f / np.sqrt(2),
        "shear": f / np.sqrt(2),
    }
