"""Noise of channels and residuals [units of the channel], stated by the rig or estimated from a recording."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Fingertip, Rig
from hmmseg.levels import SHOWN
from hmmseg.segmentation.emissions import noise_sd

# Changes between two samples: jumps of velocities and accelerations, blocks pushed by fingers.
#
# No rule that combines samples reproduces motion that changes faster than they are taken. Its error shows in
# differences of high order, which are small for smooth motion.

SEEN = 2.0  # prior: sds of a fourth difference below which it is noise
FOURTH = (1.0, -4.0, 6.0, -4.0, 1.0)  # numerics: weights of a fourth difference
MEDIAN = 0.4549  # physics: median of the square of a standard normal number
JUMPS = 64  # numerics: moments between two samples that are averaged over


def changes(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Larger change (N, ...) to either neighbour in excess of `noise` (N,); zero where missing."""
    step = np.abs(np.nan_to_num(np.diff(values, axis=0)))
    step = np.pad(step, [(1, 1), *[(0, 0)] * (values.ndim - 1)])
    usual = SHOWN * np.sqrt(2.0) * noise.reshape(-1, *[1] * (values.ndim - 1))
    return np.maximum(np.maximum(step[:-1], step[1:]) - usual, 0.0)


def speed_jumps(place: np.ndarray, noise: np.ndarray, step: float, group: int) -> np.ndarray:
    """Root mean square error (N,) of the rule for velocities where they jump between samples.

    The jump is read from the fourth difference of the positions, which are much more accurate than
    velocities: noise of the latter does not hide it. Changes that irregular sample times cause in any motion
    are no jumps.
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
        late = max(float(np.median(seen / speed[moving] ** 2)), 0.0)  # s^2; variance of the sample times
    usual = SEEN * norm * np.sqrt(noise**2 + late * speed**2)
    return _of_a_jump(group) / step * np.sqrt(np.maximum(near**2 - usual**2, 0.0))


def _sampled(group: int, *courses: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """15 samples (JUMPS, 15) of courses about each moment of a jump, means over `group` finer ones.

    Time is in samples from the jump.
    """
    when = (np.arange(JUMPS) + 0.5) / JUMPS
    t = (np.arange(15 * group) - 7 * group + 0.5) / group - when[:, None]
    return [course(t).reshape(JUMPS, 15, group).mean(2) for course in courses]


@cache
def _of_a_jump(group: int) -> float:
    """Error of the rule (1, 4, 1) / 6 for velocities at a jump, over the fourth difference of positions.

    Root mean square over the moment of the jump between two samples, each a mean over `group` finer ones.
    """
    place, speed = _sampled(group, lambda t: np.maximum(t, 0.0), lambda t: 1.0 * (t > 0))
    rule = (speed[:, :-2] + 4 * speed[:, 1:-1] + speed[:, 2:]) / 6 - (place[:, 2:] - place[:, :-2]) / 2
    bend = np.abs(np.stack([np.convolve(row, FOURTH, "valid") for row in place]))
    bend = np.pad(bend, ((0, 0), (2, 2)))
    near = np.maximum(np.maximum(bend[:, :-2], bend[:, 2:]), bend[:, 1:-1])
    return float(np.sqrt(np.square(rule).sum() / np.square(near).sum()))


def kinks(speed: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Fourth differences (N,) of a velocity near each sample in excess of its `noise` (N,): jumps of
    acceleration.
    """
    usual = SEEN * np.linalg.norm(FOURTH) * noise
    return np.sqrt(np.maximum(_near(speed) ** 2 - usual**2, 0.0))


def _near(speed: np.ndarray) -> np.ndarray:
    """Largest fourth difference (N,) that involves each sample."""
    reach = len(FOURTH) - 1
    every = np.pad(np.abs(np.convolve(np.nan_to_num(speed), FOURTH, "valid")), (reach, reach))
    return np.max([every[k : k + speed.size] for k in range(reach + 1)], axis=0)


@cache
def of_a_kink(group: int) -> tuple[float, float]:
    """Errors at a jump of the acceleration, over the fourth difference of velocities.

    Root mean squares over the moment of the jump between two samples, each a mean over `group` finer ones.

    Returns:
        Those of the rule (1, 4, 1) / 6 for velocities and of slopes from five velocities (times the time
            step).
    """
    place, speed, rate = _sampled(
        group, lambda t: np.maximum(t, 0.0) ** 2 / 2, lambda t: np.maximum(t, 0.0), lambda t: 1.0 * (t > 0)
    )
    mean = (speed[:, 1:-3] + 4 * speed[:, 2:-2] + speed[:, 3:-1]) / 6 - (place[:, 3:-1] - place[:, 1:-3]) / 2
    near, far = speed[:, 3:-1] - speed[:, 1:-3], speed[:, 4:] - speed[:, :-4]
    slope = (4 * near / 2 - far / 4) / 3 - rate[:, 2:-2]
    bend = np.square([_near(row)[2:-2] for row in speed]).sum()
    return tuple(float(np.sqrt(np.square(rule).sum() / bend)) for rule in (mean, slope))  # type: ignore


UNSEEN = 0.03  # prior: share of a force's change between samples that no model of 20 Hz samples determines,
# chosen: and of the change as a block leaves or meets its support, whose speed is not recorded
STARTING = 0.1
FADED, FADING = 0.1, 0.5  # prior: share of forces in free motion, so many seconds from a grip
ROCKING = 0.1  # prior: rise of a pushed block's sides as it rocks, relative to its motion, sd
FOAM = 2e-3  # prior: s; a pad's damping over its stiffness, as in `simgap.world.virtual_model`
NUDGE = 1e-4  # prior: m; motion of a resting block between fingers that push unequally


def sample_noise(s: Signals, group: int) -> dict[str, np.ndarray]:
    """Noise (N,) of one finger's x, y, vx, vy and force, as means over `group` samples.

    That of a jointed finger varies with its pose. What the rig does not state is estimated from the
    recording.
    """

    def known(stated: np.ndarray | float, values: np.ndarray, factor: float) -> np.ndarray:
        each = np.broadcast_to(stated, s.t.shape)
        there = np.isfinite(each)
        if there.any():
            return np.where(there, each, np.median(each[there])) / np.sqrt(group)
        learned = noise_sd(values) * factor  # of averaged samples
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
    """Noise (N, 3) of recorded angles [rad] (coordinates [m] of a Cartesian hand), their rates, and forces
    [N].

    It is no larger than the recording shows: means of velocities that a drive derives from angles are quieter
    than the stated noise of a single one.

    Args:
        joints, rates: Angles and rates (N, 4), means over `group` samples.
        one: Noise of one finger, from `sample_noise`.
        rig: The hand.
        group: Number of samples averaged into one.
    """
    stated = (one["x"], one["vx"]) if not rig.jointed else (rig.noise.angle, rig.noise.velocity)
    out = np.empty((len(joints), 3))
    for k, (known, values) in enumerate(zip(stated, (joints, rates), strict=True)):
        shown = float(np.median([noise_sd(column) for column in values.T]))
        stated = shown if known is None else known / (np.sqrt(group) if rig.jointed else 1.0)
        out[:, k] = np.fmin(stated, shown)
    out[:, 2] = one["force"]
    return np.nan_to_num(out)


def channel_noise(one: dict[str, np.ndarray]) -> np.ndarray:
    """Noise (N, C) of one sample of x, y, distance, offset, vx, vy, fx, fy, grip, shear."""
    root2 = np.sqrt(2.0)
    x, y, f = one["x"], one["y"], one["force"]
    return np.stack([x / root2, y / root2, root2 * x, root2 * y, one["vx"] / root2, one["vy"] / root2,
                     root2 * f, root2 * f, f / root2, f / root2], 1)  # fmt: skip


def residual_noise(one: dict[str, np.ndarray], rig: Rig, step: float) -> np.ndarray:
    """Noise (N, C) of each channel's residual.

    Positions are corrected for the pads' compression; velocities are compared with differences of positions
    `step` seconds apart.
    """
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
    s: Signals, one: dict[str, np.ndarray], push: np.ndarray, step: float, group: int, pad: Fingertip
) -> np.ndarray:
    """Standard deviation (N, C) of errors of the residuals' equations, beyond noise.

    Pushed blocks rock, and no rule reproduces velocities that change within a sample, such as that of a
    released fingertip. While pads deform quickly, their damping carries a part of the force.

    Args:
        s: Task-space signals.
        one: Noise of one finger, from `sample_noise`.
        push: Motion of the fingers (N,) beyond noise [m].
        step: Time between samples [s].
        group: Number of recorded samples averaged into one.
        pad: The fingertip.
    """
    root2, out = np.sqrt(2.0), np.zeros((s.t.size, 10))
    out[:, 0], out[:, 1], out[:, 3] = NUDGE, ROCKING * push, 2 * ROCKING * push
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
    """What no model of coarse samples determines (N, 4) of net fx, net fy, grip and shear [N].

    A share of the largest change between samples within two samples, larger where a carry is `starting` or
    ending. Just after a grip, in addition, a share of the recorded force, which stems from between samples.
    """
    every = np.concatenate([force[:, :2] + force[:, 2:], (force[:, :2] - force[:, 2:]) / 2], 1)
    step = np.pad(np.abs(np.diff(every, axis=0)), ((2, 2), (0, 0)))
    change = np.max([step[k : k + len(force)] for k in range(4)], axis=0)
    after = free & (np.abs(t[:, None] - boundaries) < FADING).any(axis=1)
    share = np.where(starting, STARTING, UNSEEN)[:, None]
    return np.maximum(share * change, FADED * np.abs(every) * after[:, None])
