"""Noise of channels and of residuals [units of the channel], from the rig or learned from a recording."""

from __future__ import annotations

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.features import noise_sd

MISFIT = 0.03  # chosen: share of a force's change between samples that no model of 20 Hz samples can tell,
# chosen: and of that with which a block comes off its support or onto it: how fast is not recorded
STARTING = 0.1
FADED, FADING = 0.1, 0.5  # chosen: the same of what is recorded in free motion, so many seconds from a grip
# chosen: share of a speed's fourth difference by which the rule for differences of positions is off
BENT = 0.025
SEEN = 2.0  # chosen: sds of that difference below which it is noise
MOVES = 3.0  # chosen: sds of a difference by which fingers move
NUDGE = 1e-4  # chosen: m; fingers that push unequally move a resting block by about as much


def sample_noise(s: Signals, rig: Rig, group: int) -> dict[str, np.ndarray]:
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


def channel_noise(one: dict[str, np.ndarray]) -> np.ndarray:
    """Noise (N, C) of one sample of x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    root2 = np.sqrt(2.0)
    x, y, f = one["x"], one["y"], one["force"]
    return np.stack([x / root2, y / root2, root2 * x, root2 * y, one["vx"] / root2, one["vy"] / root2,
                     root2 * f, root2 * f, f / root2, f / root2], 1)  # fmt: skip


def residual_noise(s: Signals, one: dict[str, np.ndarray], rig: Rig, step: float) -> np.ndarray:
    """Noise (N, C) of each channel's residual: positions with the pads' yielding taken out, velocities less
    differences of positions `step` s apart.

    Where the speed changes within a sample, as that of a pressed fingertip that is let go, no rule gives it.
    """
    pad, root2 = rig.fingertip, np.sqrt(2.0)
    x, y, vx, vy, f = (one[k] for k in ("x", "y", "vx", "vy", "force"))
    gn, gs = f / pad.normal_stiffness, f / pad.shear_stiffness
    columns = [
        np.hypot(np.hypot(x, gn) / root2, NUDGE), np.hypot(y, gs) / root2,
        root2 * np.hypot(x, gn), root2 * np.hypot(y, gs),
        np.hypot(0.5 * vx, 0.5 * x / step), np.hypot(0.5 * vy, 0.5 * y / step),
        root2 * f, root2 * f, f / root2, f / root2,
    ]  # fmt: skip
    out = np.stack(columns, 1)
    out[:, 0] = np.hypot(out[:, 0], _moving((s.x1 + s.x2) / 2, x / root2))
    for channel, fingers, noise in ((4, (s.vx1, s.vx2), vx), (5, (s.vy1, s.vy2), vy)):
        unresolved = sum(_unresolved(speed, noise) for speed in fingers) / 2
        out[:, channel] = np.hypot(out[:, channel], unresolved)
    return out


def _moving(place: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """By how much (N,) fingers move from sample to sample beyond noise: what they hold does not rest then.

    The finger that touches first pushes the block for a while, and so does a hand that closes.
    """
    step = np.pad(np.abs(np.nan_to_num(np.diff(place))), (1, 1))
    return np.maximum(np.maximum(step[:-1], step[1:]) - MOVES * np.sqrt(2.0) * noise, 0.0)


def _unresolved(speed: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """How far (N,) a fingertip's speed is off from differences of positions, by its fourth difference."""
    bend = np.zeros_like(speed)
    bend[2:-2] = np.abs(np.convolve(speed, (1, -4, 6, -4, 1), "valid"))
    usual = SEEN * np.sqrt(70.0) * noise  # 70: the squares of these weights
    return BENT * np.maximum(np.nan_to_num(bend) - usual, 0.0)


def misfit(
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
    share = np.where(starting, STARTING, MISFIT)[:, None]
    return np.maximum(share * change, FADED * np.abs(every) * after[:, None])
