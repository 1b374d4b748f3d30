"""Noise of channels and of residuals [units of the channel], from the rig or learned from a recording."""

from __future__ import annotations

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Fingertip, Rig
from hmmseg.segmentation.emissions import noise_sd
from simgap.gap.unresolved import changes, kinks, of_a_kink, pushed, speed_jumps

UNSEEN = 0.03  # prior: share of a force's change between samples that no model of 20 Hz samples can tell,
# chosen: and of that with which a block comes off its support or onto it: how fast is not recorded
STARTING = 0.1
FADED, FADING = 0.1, 0.5  # prior: the same of what is recorded in free motion, so many seconds from a grip
ROCKING = 0.1  # prior: a block that is pushed rocks: its sides rise by so much of how far it goes, sd
FOAM = 2e-3  # prior: s; a pad's damping over its stiffness, as `simgap.world.scene` has it
NUDGE = 1e-4  # prior: m; fingers that push unequally move a resting block by about as much


def sample_noise(s: Signals, group: int) -> dict[str, np.ndarray]:
    """Noise (N,) of one finger's x, y, vx, vy and force, of means over `group` samples.

    A jointed finger's changes with its pose. Learned from the recording where the rig does not state it.
    """

    def known(stated: np.ndarray | float, values: np.ndarray, factor: float) -> np.ndarray:
        each = np.broadcast_to(stated, s.t.shape)
        there = np.isfinite(each)
        if there.any():
            return np.where(there, each, np.median(each[there])) / np.sqrt(group)
        learned = noise_sd(values) * factor  # of what is averaged already
        return np.full(s.t.shape, max(learned if np.isfinite(learned) else 0.0, 1e-9))

    root2 = np.sqrt(2.0)
    return {
        "x": known(s.sd_x, s.x, root2), "y": known(s.sd_y, s.y, root2),
        "vx": known(s.sd_vx, s.vx, root2), "vy": known(s.sd_vy, s.vy, root2),
        "force": known(s.sd_force, s.fy, 1 / root2),
    }  # fmt: skip


def sensor_sd(
    joints: np.ndarray, rates: np.ndarray, one: dict[str, np.ndarray], rig: Rig, group: int
) -> np.ndarray:
    """Noise (N, 3) of what was recorded, means over `group` samples: an angle [rad] (a coordinate [m] of a
    Cartesian hand), its rate and a force [N]. `joints`, `rates` (N, 4); `one` of `sample_noise`.

    Not more than the recording shows: means of speeds that a drive makes of its angles are quieter than what
    is stated of one.
    """
    stated = (one["x"], one["vx"]) if not rig.jointed else (rig.noise.angle, rig.noise.velocity)
    out = np.empty((len(joints), 3))
    for k, (known, values) in enumerate(zip(stated, (joints, rates), strict=True)):
        shown = float(np.median([noise_sd(column) for column in values.T]))
        told = shown if known is None else known / (np.sqrt(group) if rig.jointed else 1.0)
        out[:, k] = np.fmin(told, shown)
    out[:, 2] = one["force"]
    return np.nan_to_num(out)


def channel_noise(one: dict[str, np.ndarray]) -> np.ndarray:
    """Noise (N, C) of one sample of x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    root2 = np.sqrt(2.0)
    x, y, f = one["x"], one["y"], one["force"]
    return np.stack([x / root2, y / root2, root2 * x, root2 * y, one["vx"] / root2, one["vy"] / root2,
                     root2 * f, root2 * f, f / root2, f / root2], 1)  # fmt: skip


def residual_noise(one: dict[str, np.ndarray], rig: Rig, step: float) -> np.ndarray:
    """Noise (N, C) of each channel's residual: positions with the pads' yielding taken out, velocities less
    differences of positions `step` s apart."""
    pad, root2 = rig.fingertip, np.sqrt(2.0)
    x, y, vx, vy, f = (one[k] for k in ("x", "y", "vx", "vy", "force"))
    gn, gs = f / pad.normal_stiffness, f / pad.shear_stiffness
    columns = [
        np.hypot(x, gn) / root2, np.hypot(y, gs) / root2, root2 * np.hypot(x, gn), root2 * np.hypot(y, gs),
        np.hypot(0.5 * vx, 0.5 * x / step), np.hypot(0.5 * vy, 0.5 * y / step),
        root2 * f, root2 * f, f / root2, f / root2,
    ]  # fmt: skip
    return np.stack(columns, 1)


def motion_doubt(
    s: Signals, one: dict[str, np.ndarray], step: float, group: int, pad: Fingertip
) -> np.ndarray:
    """How far (N, C) residuals are off beyond noise where motion is not what equations take it for, sd.

    Fingers that push a block move it, and speeds that change within a sample, as that of a pressed fingertip
    that is let go, no rule gives; while pads give way quickly, their damping bears a part of the force.
    Samples are means over `group` finer ones.
    """
    root2, out = np.sqrt(2.0), np.zeros((s.t.size, 10))
    push = pushed(mean_of(s, "x"), one["x"] / root2)
    out[:, 0], out[:, 1], out[:, 3] = np.hypot(NUDGE, push), ROCKING * push, 2 * ROCKING * push
    damped = FOAM / step * changes(np.stack([s.fx1, s.fy1, s.fx2, s.fy2], 1), one["force"])
    normal, shear = damped[:, ::2] / pad.normal_stiffness, damped[:, 1::2] / pad.shear_stiffness
    for channel, each in ((0, normal / 2), (1, shear / 2), (2, normal), (3, shear)):
        out[:, channel] = np.hypot(out[:, channel], each.sum(axis=1))
    for channel, axis in ((4, "x"), (5, "y")):
        place, speed = (mean_of(s, name) for name in (axis, f"v{axis}"))
        jump = speed_jumps(place, one[axis] / root2, step, group)
        out[:, channel] = np.hypot(jump, of_a_kink(group)[0] * kinks(speed, one[f"v{axis}"] / root2))
    return out


def mean_of(s: Signals, name: str) -> np.ndarray:
    """Mean (N,) of both fingers' x, y, vx or vy."""
    return (s.__dict__[f"{name}1"] + s.__dict__[f"{name}2"]) / 2


def between_samples(
    t: np.ndarray, force: np.ndarray, free: np.ndarray, starting: np.ndarray, boundaries: np.ndarray
) -> np.ndarray:
    """What no model of coarse samples can tell (N, 4) of net fx, net fy, grip and shear [N].

    A share of the largest change from sample to sample, two samples around, more of it where a carry is
    `starting` or ending; and just after a grip a share of what is still recorded, for it tells of forces
    between samples.
    """
    every = np.concatenate([force[:, :2] + force[:, 2:], (force[:, :2] - force[:, 2:]) / 2], 1)
    step = np.pad(np.abs(np.diff(every, axis=0)), ((2, 2), (0, 0)))
    change = np.max([step[k : k + len(force)] for k in range(4)], axis=0)
    after = free & (np.abs(t[:, None] - boundaries) < FADING).any(axis=1)
    share = np.where(starting, STARTING, UNSEEN)[:, None]
    return np.maximum(share * change, FADED * np.abs(every) * after[:, None])
