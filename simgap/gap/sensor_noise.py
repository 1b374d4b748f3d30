"""Noise of channels and of residuals [units of the channel], from the rig or learned from a recording."""

from __future__ import annotations

from functools import cache

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.features import noise_sd

MISFIT = 0.03  # prior: share of a force's change between samples that no model of 20 Hz samples can tell,
# chosen: and of that with which a block comes off its support or onto it: how fast is not recorded
STARTING = 0.1
FADED, FADING = 0.1, 0.5  # prior: the same of what is recorded in free motion, so many seconds from a grip
SEEN = 2.0  # prior: sds of a fourth difference below which it is noise
FOURTH = (1.0, -4.0, 6.0, -4.0, 1.0)  # numerics: weights of a fourth difference
MEDIAN = 0.4549  # physics: of the square of a standard normal number
JUMPS = 64  # numerics: moments between two samples that a mean is taken over
MOVES = 3.0  # chosen: sds of a difference by which fingers move
NUDGE = 1e-4  # prior: m; fingers that push unequally move a resting block by about as much


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


def sensor_sd(
    joints: np.ndarray, rates: np.ndarray, one: dict[str, np.ndarray], rig: Rig, group: int
) -> np.ndarray:
    """Noise (N, 3) of what was recorded, means over `group` samples: an angle [rad] (a coordinate [m] of a
    Cartesian hand), its rate and a force [N]. `joints`, `rates` (N, 4); `one` of `sample_noise`."""
    if not rig.jointed:
        return np.stack([one["x"], one["vx"], one["force"]], 1)
    out = np.empty((len(joints), 3))
    for k, (stated, values) in enumerate(((rig.noise.angle, joints), (rig.noise.velocity, rates))):
        learned = np.median([noise_sd(column) for column in values.T])
        out[:, k] = learned if stated is None else stated / np.sqrt(group)
    out[:, 2] = one["force"]
    return np.nan_to_num(out)


def channel_noise(one: dict[str, np.ndarray]) -> np.ndarray:
    """Noise (N, C) of one sample of x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    root2 = np.sqrt(2.0)
    x, y, f = one["x"], one["y"], one["force"]
    return np.stack([x / root2, y / root2, root2 * x, root2 * y, one["vx"] / root2, one["vy"] / root2,
                     root2 * f, root2 * f, f / root2, f / root2], 1)  # fmt: skip


def residual_noise(
    s: Signals, one: dict[str, np.ndarray], rig: Rig, step: float, group: int = 1
) -> np.ndarray:
    """Noise (N, C) of each channel's residual: positions with the pads' yielding taken out, velocities less
    differences of positions `step` s apart, all of them means over `group` samples.

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
    for channel, place, noise in ((4, (s.x1 + s.x2) / 2, x), (5, (s.y1 + s.y2) / 2, y)):
        out[:, channel] = np.hypot(out[:, channel], _unresolved(place, noise / root2, step, group))
    return out


def _moving(place: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """By how much (N,) fingers move from sample to sample beyond noise: what they hold does not rest then.

    The finger that touches first pushes the block for a while, and so does a hand that closes.
    """
    step = np.pad(np.abs(np.nan_to_num(np.diff(place))), (1, 1))
    return np.maximum(np.maximum(step[:-1], step[1:]) - MOVES * np.sqrt(2.0) * noise, 0.0)


def _unresolved(place: np.ndarray, noise: np.ndarray, step: float, group: int) -> np.ndarray:
    """How far (N,) the rule for speeds is off where they jump between samples, rms over when they do.

    The jump shows in the fourth difference of the positions, which are known far better than speeds: how
    loud those are makes it no smaller. What irregular sample times do wherever a finger moves is no jump.
    """
    bend, speed, norm = np.zeros_like(place), np.zeros_like(place), np.linalg.norm(FOURTH)
    place = np.nan_to_num(place)
    bend[2:-2] = np.abs(np.convolve(place, FOURTH, "valid"))
    speed[1:-1] = np.abs(place[2:] - place[:-2]) / (2 * step)
    near = np.maximum(np.maximum(bend, np.roll(bend, 1)), np.roll(bend, -1))
    moving = speed > np.sqrt(np.mean(speed**2))
    late = 0.0
    if moving.any():
        seen = (bend**2 / (MEDIAN * norm**2) - noise**2)[moving]
        late = max(float(np.median(seen / speed[moving] ** 2)), 0.0)  # s^2, variance of the sample times
    usual = SEEN * norm * np.sqrt(noise**2 + late * speed**2)
    return _of_a_jump(group) / step * np.sqrt(np.maximum(near**2 - usual**2, 0.0))


@cache
def _of_a_jump(group: int) -> float:
    """What the rule (1, 4, 1) / 6 for speeds leaves where one jumps, over the fourth difference of positions.

    In the mean square over when it jumps between two samples, each a mean over `group` finer ones.
    """
    when = (np.arange(JUMPS) + 0.5) / JUMPS
    t = (np.arange(15 * group) - 7 * group + 0.5) / group - when[:, None]
    place, speed = (z.reshape(JUMPS, 15, group).mean(2) for z in (np.maximum(t, 0.0), 1.0 * (t > 0)))
    rule = (speed[:, :-2] + 4 * speed[:, 1:-1] + speed[:, 2:]) / 6 - (place[:, 2:] - place[:, :-2]) / 2
    bend = np.abs(np.stack([np.convolve(row, FOURTH, "valid") for row in place]))
    bend = np.pad(bend, ((0, 0), (2, 2)))
    near = np.maximum(np.maximum(bend[:, :-2], bend[:, 2:]), bend[:, 1:-1])
    return float(np.sqrt(np.square(rule).sum() / np.square(near).sum()))


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
