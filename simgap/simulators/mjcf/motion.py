"""The recorded motion, smoothed, and the torques that the model says it took (inverse dynamics)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.model import MjcfSimulator
from simgap.simulators.recording import Recording

SPAN = 0.06  # chosen: s over which a motion is smoothed by a cubic


@dataclass(frozen=True)
class Motion:
    """By joint, along a log's samples: position, rate, acceleration and the torque that they take (n,)."""

    position: dict[int, np.ndarray]
    rate: dict[int, np.ndarray]
    acceleration: dict[int, np.ndarray]
    torque: dict[int, np.ndarray]


def motion_of(simulator: MjcfSimulator, log: Recording) -> Motion:
    """The motion along a log; joints that no column tells rest where the model has them."""
    model = simulator.model
    position, rate, acceleration = {}, {}, {}
    for column, joint in simulator.joints.items():
        position[joint], rate[joint], acceleration[joint] = smoothed(log.t, log[column])
    data = mujoco.MjData(model)
    torque = {j: np.zeros(len(log)) for j in position}
    rows = np.arange(0, len(log), max(1, round(len(log) / max(float(log.t[-1] - log.t[0]) * 100.0, 1.0))))
    for i in rows:
        for j in position:
            q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            data.qpos[q], data.qvel[v], data.qacc[v] = position[j][i], rate[j][i], acceleration[j][i]
        mujoco.mj_inverse(model, data)
        for j in position:
            torque[j][i] = data.qfrc_inverse[model.jnt_dofadr[j]]
    full = {j: np.interp(log.t, log.t[rows], values[rows]) for j, values in torque.items()}
    return Motion(position, rate, acceleration, full)


def smoothed(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, rate and acceleration (n,), by cubics over SPAN (Savitzky & Golay 1964)."""
    seen = np.isfinite(values)
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + 0.5 * step, step)
    even = np.interp(grid, t[seen], values[seen])
    width = min(max(7, 2 * round(SPAN / step / 2) + 1), (grid.size - 1) // 2 * 2 + 1)
    order = min(3, width - 1)
    return tuple(  # type: ignore[return-value]
        np.interp(t, grid, np.asarray(savgol_filter(even, width, order, deriv=d, delta=step)))
        for d in range(3)
    )
