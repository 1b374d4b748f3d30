"""Task-space signals of a two-finger hand (paper, Section 3.3) and their sample noise.

Fingers are x1, y1, ... (left) and x2, y2, ... (right); the object sees their means and
differences. Positions are the undeformed contact faces, forces what a fingertip exerts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.hand.kinematics import forward, jacobian
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.trial import ROLL, Trial
from hmmseg.tables import Brief


@dataclass(frozen=True, repr=False)
class Signals(Brief):
    """Fingertip signals of one trial, arrays (num_timesteps,), NaN where missing.

    Positions [m], velocities [m/s] and forces [N]; `sd_*` are the standard deviations of one
    sample's noise, NaN where the rig does not state them.
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
    touches: tuple[tuple[float, float], ...] = ()  # times of touch and release known apart, and sds [s]
    timing: np.ndarray | None = None  # sd of when a force changed that changes there [s]
    free: np.ndarray | None = None  # share of a sample in which nothing is held for sure
    roll: np.ndarray | None = None  # of the hand [rad], where recorded; the rest is as if it had none
    coupled: bool = False  # both fingers are one gripper's: what they differ by in height is a roll

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
    return Signals(t=trial.t, **out, **sds, sd_force=force, derived=derived,  # type: ignore[arg-type]
                   touches=trial.touches, timing=trial.timing, free=trial.free,
                   roll=channels.get(ROLL), coupled=not rig.jointed)  # fmt: skip


def _square(sd: float | None) -> float:
    return np.nan if sd is None else sd**2


def central_differences(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences over the samples that are there, and the time [s] each spans.

    NaN where the sample is missing.
    """
    out, window, there = np.full_like(values, np.nan), np.full_like(values, np.nan), np.isfinite(values)
    if there.sum() > 1:
        out[there] = np.gradient(values[there], t[there])
        neighbours = np.pad(t[there], 1, mode="edge")
        window[there] = neighbours[2:] - neighbours[:-2]
    return out, window
