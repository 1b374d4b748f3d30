"""Task-space signals of a two-finger hand (paper, Section 3.3) and their sample noise.

Fingers are x1, y1, ... (left) and x2, y2, ... (right); the object sees their means and differences. Positions
are the undeformed contact faces, forces are exerted by the fingertips.

Velocities that a drive computes from its own positions come late. Without a tachometer,

    v[k] = (x[k] - x[k-m]) / (t[k] - t[k-m])

is the velocity m / 2 samples ago, with the positions' noise. At 20 Hz that is 25 ms, more than the admissible
error of a contact change.

The fingers of one gripper, and what they hold, may roll together about their midpoint. Given as the column
`hand_roll` [rad] (counterclockwise, 0 where the fingers are level), a roll is removed as the recording is
read: differences between the fingers are rotated back; their mean position and the sum of their forces stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmmseg.contact.equations import turned
from hmmseg.errors import InputError
from hmmseg.hand.kinematics import forward, jacobian
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.trial import ROLL, Trial, position_pairs
from hmmseg.robust import bridged
from hmmseg.tables import Brief

STEEPEST = 0.5  # limit: rad; a hand rolled further holds no upright block (and degrees are larger)


def group_size(rate: float, max_rate: float) -> int:
    """How many samples at `rate` [Hz] make one at `max_rate` or less."""
    return int(np.ceil(rate / max_rate - 1e-6))


def grouped(values: np.ndarray, group: int, width: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Means (M, ...) over each `group` of samples of values (N, ...), and the number of values in each.

    Only the first `width` samples of a group count, all by default. An incomplete last group is dropped, and
    the mean of no values is NaN.
    """
    width = group if width is None else width
    starts = np.arange(0, len(values) - width + 1, group)
    block = values[starts[:, None] + np.arange(width)]
    there = np.isfinite(block)
    count = there.sum(axis=1)
    mean = np.where(there, block, 0.0).sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan), count


@dataclass(frozen=True, repr=False)
class Signals(Brief):
    """Fingertip signals of one trial, arrays (num_timesteps,), NaN where missing.

    Positions [m], velocities [m/s] and forces [N]; `sd_*` are noise standard deviations of one sample, NaN
    where the rig does not state them.
    """

    t: np.ndarray
    x1: np.ndarray
    y1: np.ndarray
    vx1: np.ndarray
    vy1: np.ndarray
    fx1: np.ndarray
    fy1: np.ndarray
    x2: np.ndarray
    y2: np.ndarray
    vx2: np.ndarray
    vy2: np.ndarray
    fx2: np.ndarray
    fy2: np.ndarray
    sd_x: np.ndarray  # of one finger's x
    sd_y: np.ndarray
    sd_vx: np.ndarray
    sd_vy: np.ndarray
    sd_force: float
    derived: bool = False  # velocities are differences of positions
    touches: tuple[tuple[float, float], ...] = ()  # known times of touch and release, and their sds [s]
    timing: np.ndarray | None = None  # sd of the time at which a force changes [s]
    free: np.ndarray | None = None  # share of a sample in which surely nothing is held

    @property
    def x(self) -> np.ndarray:
        """Mean horizontal position [m]."""
        return (self.x1 + self.x2) / 2

    @property
    def y(self) -> np.ndarray:
        """Mean vertical position [m]."""
        return (self.y1 + self.y2) / 2

    @property
    def distance(self) -> np.ndarray:
        """Horizontal distance between the fingers, x2 - x1 [m]."""
        return self.x2 - self.x1

    @property
    def offset(self) -> np.ndarray:
        """Vertical offset of the fingers, y2 - y1 [m]."""
        return self.y2 - self.y1

    @property
    def vx(self) -> np.ndarray:
        """Mean horizontal velocity [m/s]."""
        return (self.vx1 + self.vx2) / 2

    @property
    def vy(self) -> np.ndarray:
        """Mean vertical velocity [m/s]."""
        return (self.vy1 + self.vy2) / 2

    @property
    def fx(self) -> np.ndarray:
        """Net horizontal force on the environment [N]."""
        return self.fx1 + self.fx2

    @property
    def fy(self) -> np.ndarray:
        """Net vertical force on the environment [N]."""
        return self.fy1 + self.fy2

    @property
    def grip(self) -> np.ndarray:
        """Grip normal force min(fx1, -fx2) [N]."""
        return np.minimum(self.fx1, -self.fx2)

    @property
    def shear(self) -> np.ndarray:
        """Grip shear force (fy1 - fy2) / 2 [N]."""
        return (self.fy1 - self.fy2) / 2


def task_space(trial: Trial, rig: Rig) -> Signals:
    """Signals of a trial: forward kinematics, and the Jacobian for velocities, of the rig."""
    channels, noise, n = trial.channels, rig.noise, trial.t.size
    for name in (*FORCE_CHANNELS, *(JOINTS if rig.jointed else ("x1", "y1", "x2", "y2"))):
        if name not in channels:  # of a trial that was made rather than read
            raise InputError(trial.file, f"has no channel {name}", "those that Trial.read finds")
    out: dict[str, np.ndarray] = {f: channels[f] for f in FORCE_CHANNELS}
    derived = False
    variances = {"x": np.zeros(n), "y": np.zeros(n), "vx": np.zeros(n), "vy": np.zeros(n)}
    for i in (1, 2):
        if rig.jointed:
            finger = rig.finger(i)
            q = np.stack([channels[f"q{i}1"], channels[f"q{i}2"]], -1)
            dq = np.stack([channels[f"dq{i}1"], channels[f"dq{i}2"]], -1)
            turning = jacobian(finger, q)
            out[f"x{i}"], out[f"y{i}"] = forward(finger, q).T
            out[f"vx{i}"], out[f"vy{i}"] = (turning * dq[:, None, :]).sum(-1).T
            reach = dict(zip("xy", (turning**2).sum(-1).T, strict=True))
            for axis in "xy":
                variances[axis] += reach[axis] * _square(noise.angle) / 2
                variances[f"v{axis}"] += reach[axis] * _square(noise.velocity) / 2
        else:
            for axis in "xy":
                position = channels[f"{axis}{i}"]
                out[f"{axis}{i}"] = position
                velocity, variance = channels.get(f"v{axis}{i}"), _square(noise.velocity)
                if velocity is None:
                    derived = True
                    velocity, window = central_differences(trial.t, position)
                    variance = 2 * _square(noise.position) / window**2
                out[f"v{axis}{i}"] = velocity
                variances[axis] += _square(noise.position) / 2
                variances[f"v{axis}"] += variance / 2
    sds = {f"sd_{name}": np.sqrt(variance) for name, variance in variances.items()}
    force = np.nan if noise.force is None else noise.force
    return Signals(t=trial.t, **out, **sds, sd_force=force, derived=derived,
                   touches=trial.touches, timing=trial.timing, free=trial.free)  # fmt: skip


def _square(sd: float | None) -> float:
    return np.nan if sd is None else sd**2


def central_differences(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences over the samples that are present, and the time [s] that each spans.

    NaN where the sample is missing.
    """
    out, window, there = np.full_like(values, np.nan), np.full_like(values, np.nan), np.isfinite(values)
    if there.sum() > 1:
        out[there] = np.gradient(values[there], t[there])
        neighbours = np.pad(t[there], 1, mode="edge")
        window[there] = neighbours[2:] - neighbours[:-2]
    return out, window


LONGEST = 4  # chosen: samples that a drive's difference spans at most
# numerics: residual of velocities that repeat such differences, up to rounding, over that of independent ones
ALIKE = 0.1


def timely(signals: Signals, trial: Trial) -> Signals:
    """The signals with central differences instead of velocities that are late, or missing altogether."""
    dead = any(not np.isfinite(trial.channels[rate]).any() for _, rate in position_pairs(trial))
    return differenced(signals) if dead or come_late(trial) else signals


def come_late(trial: Trial) -> bool:
    """Whether a trial's velocities are backward differences of its positions."""
    c, pairs = trial.channels, position_pairs(trial)
    return bool(pairs) and all(late_differences(trial.t, c[place], c[rate]) for place, rate in pairs)


def differenced(signals: Signals) -> Signals:
    """The signals with central differences of positions as velocities."""
    made = dict[str, Any]()
    for axis in "xy":
        for i in (1, 2):
            made[f"v{axis}{i}"], window = central_differences(signals.t, getattr(signals, f"{axis}{i}"))
        made[f"sd_v{axis}"] = np.sqrt(2.0) * getattr(signals, f"sd_{axis}") / window
    return replace(signals, derived=True, **made)


def late_differences(t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> bool:
    """Whether velocity (num_timesteps,) equals the backward differences of position over some samples."""
    central = _residual(velocity[1:-1], (position[2:] - position[:-2]) / (t[2:] - t[:-2]))
    backward = [
        _residual(velocity[m:], (position[m:] - position[:-m]) / (t[m:] - t[:-m]))
        for m in range(1, min(LONGEST + 1, t.size - 1))
    ]
    return bool(backward) and bool(min(backward) < ALIKE * central)


def one_sided(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Rates (2, num_timesteps) of change just before and just after each sample, and their relative noise
    [1/s].

    Each uses samples of its own side, as a difference across a touch belongs to neither: the slope at the end
    of a parabola through three readings.
    """
    there = np.isfinite(values)
    h = float(np.median(np.diff(t)))
    noise = float(np.sqrt(1.5**2 + 2**2 + 0.5**2) / h)
    if there.sum() < 2:
        return np.full((2, t.size), np.nan), noise

    def read(at: np.ndarray) -> np.ndarray:
        return np.interp(at, t[there], values[there])

    before = (1.5 * values - 2 * read(t - h) + 0.5 * read(t - 2 * h)) / h
    after = (-1.5 * values + 2 * read(t + h) - 0.5 * read(t + 2 * h)) / h
    return np.stack([before, after]), noise


def _residual(velocity: np.ndarray, difference: np.ndarray) -> float:
    """Mean absolute residual [m/s or rad/s], infinite if there is none."""
    apart = np.abs(velocity - difference)
    apart = apart[np.isfinite(apart)]
    return float(apart.mean()) if apart.size else np.inf


def with_heights(signals: Signals, trial: Trial, rig: Rig) -> Signals:
    """The signals with heights wherever the coordinates can be interpolated over time.

    A height takes four link angles: if two readings in five are missing, all four are present in one sample
    of eight. Only for decisions about a fraction of the hand's travel, as interpolation has its own error.
    """
    names = JOINTS if rig.jointed else ("y1", "y2")
    known = {name: np.isfinite(trial.channels[name]) for name in names}
    if all(k.all() for k in known.values()) or not all(k.any() for k in known.values()):
        return signals
    filled = {name: bridged(trial.channels[name], trial.t) for name in names}
    whole = task_space(replace(trial, channels=trial.channels | filled), rig)
    return replace(signals, y1=whole.y1, y2=whole.y2, sd_y=whole.sd_y)


def remove_roll(trial: Trial) -> Trial:
    """A Cartesian trial as it would have been recorded had the hand not rolled.

    InputError for a roll at which no hand holds an upright block.
    """
    if ROLL not in trial.channels:
        return trial
    roll = trial.channels[ROLL]
    beyond = np.flatnonzero(np.abs(np.nan_to_num(roll)) > STEEPEST)
    if beyond.size:
        where = f"{trial.file}: sample {beyond[0] + 1}, column {ROLL}"
        expected = f"radians, 0 where fingers are level, at most {STEEPEST:g} either way (is it in degrees?)"
        raise InputError(where, f"{roll[beyond[0]]:.3g} rad", expected)
    roll = bridged(roll, trial.t)
    c = dict(trial.channels)
    roll_rate = np.gradient(roll, trial.t)
    level: tuple[np.ndarray, np.ndarray] | None = None
    for kind in ("", "v", "f"):
        names = [[f"{kind}{axis}{i}" for axis in "xy"] for i in (1, 2)]
        if not all(name in c for pair in names for name in pair):
            continue
        (x1, y1), (x2, y2) = ((c[x], c[y]) for x, y in names)
        across, up = turned(x2 - x1, y2 - y1, -roll)
        if kind == "":
            level = across, up
        if kind == "v" and level is not None:  # velocity of the rotating frame
            across, up = across + roll_rate * level[1], up - roll_rate * level[0]
        for sign, (x, y) in zip((-0.5, 0.5), names, strict=True):
            c[x], c[y] = (x1 + x2) / 2 + sign * across, (y1 + y2) / 2 + sign * up
    return replace(trial, channels=c)


def level_row(row: np.ndarray, roll: float) -> np.ndarray:
    """One row (12,) of CARTESIAN_CHANNELS as it would be had the hand not rolled by `roll` [rad].

    Velocities are only rotated: the rotating frame's contribution only makes the fingers differ.
    """
    first, second = row.reshape(2, 3, 2)  # positions, velocities and forces: across, up
    across, up = turned(second[:, 0] - first[:, 0], second[:, 1] - first[:, 1], -roll)
    half = np.stack([across, up], axis=1) / 2
    middle = (first + second) / 2
    return np.concatenate([middle - half, middle + half]).ravel()
