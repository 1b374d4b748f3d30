"""What happens between two samples: speeds and accelerations that jump, blocks that fingers push.

No rule through samples gives a motion that changes faster than they are taken. How far it is off shows in
differences of a high order, which smooth motion hardly has.
"""

from __future__ import annotations

from functools import cache

import numpy as np

SEEN = 2.0  # prior: sds of a fourth difference below which it is noise
FOURTH = (1.0, -4.0, 6.0, -4.0, 1.0)  # numerics: weights of a fourth difference
MEDIAN = 0.4549  # physics: of the square of a standard normal number
JUMPS = 64  # numerics: moments between two samples that a mean is taken over
MOVES = 3.0  # chosen: sds of a difference by which fingers move


def pushed(place: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """By how much (N,) fingers move from sample to sample beyond noise: what they hold does not rest then.

    The finger that touches first pushes the block for a while, and so does a hand that closes.
    """
    return changes(place, noise)


def changes(values: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The larger change (N, ...) to either neighbour beyond what `noise` (N,) makes; none where missing."""
    step = np.abs(np.nan_to_num(np.diff(values, axis=0)))
    step = np.pad(step, [(1, 1), *[(0, 0)] * (values.ndim - 1)])
    usual = MOVES * np.sqrt(2.0) * noise.reshape(-1, *[1] * (values.ndim - 1))
    return np.maximum(np.maximum(step[:-1], step[1:]) - usual, 0.0)


def speed_jumps(place: np.ndarray, noise: np.ndarray, step: float, group: int) -> np.ndarray:
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


def kinks(speed: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Fourth differences (N,) of a speed near each sample, beyond those of its `noise` (N,): its
    acceleration jumps there."""
    usual = SEEN * np.linalg.norm(FOURTH) * noise
    return np.sqrt(np.maximum(_near(speed) ** 2 - usual**2, 0.0))


def _near(speed: np.ndarray) -> np.ndarray:
    """The largest fourth difference (N,) that each sample takes part in."""
    reach = len(FOURTH) - 1
    every = np.pad(np.abs(np.convolve(np.nan_to_num(speed), FOURTH, "valid")), (reach, reach))
    return np.max([every[k : k + speed.size] for k in range(reach + 1)], axis=0)


@cache
def of_a_kink(group: int) -> tuple[float, float]:
    """What the rule (1, 4, 1) / 6 for speeds, and differences of five speeds over a sample, leave where the
    acceleration jumps, over the speeds' fourth difference.

    In the mean square over when it jumps between two samples, each a mean over `group` finer ones.
    """
    when = (np.arange(JUMPS) + 0.5) / JUMPS
    t = (np.arange(15 * group) - 7 * group + 0.5) / group - when[:, None]
    ramp = np.maximum(t, 0.0)
    place, speed, rate = (z.reshape(JUMPS, 15, group).mean(2) for z in (ramp**2 / 2, ramp, 1.0 * (t > 0)))
    mean = (speed[:, 1:-3] + 4 * speed[:, 2:-2] + speed[:, 3:-1]) / 6 - (place[:, 3:-1] - place[:, 1:-3]) / 2
    near, far = speed[:, 3:-1] - speed[:, 1:-3], speed[:, 4:] - speed[:, :-4]
    slope = (4 * near / 2 - far / 4) / 3 - rate[:, 2:-2]
    bend = np.square([_near(row)[2:-2] for row in speed]).sum()
    return tuple(float(np.sqrt(np.square(rule).sum() / bend)) for rule in (mean, slope))  # type: ignore
