"""The recorded motion: the torques that it takes, and how far gears give under them behind an encoder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import savgol_filter

from simgap.attribution.verdict import ALARM
from simgap.effect import Parameter
from simgap.robot_effects.base import RobotEffect
from simgap.robots.windows import REACH
from simgap.simulators.mjcf.engine import HINGE, SLIDE, mujoco
from simgap.simulators.mjcf.model import MjcfSimulator
from simgap.simulators.mjcf.setting import name_of, object_id
from simgap.simulators.protocol import Channels
from simgap.simulators.recording import Recording

LIGHT = 1e-6  # numerics: m N m: a smaller torque times lever counts as none
GIVES = 0.01  # prior: share of a joint's reach by which its gears usually give
SHARE = 0.03  # prior: share of a joint's torques: the usual size of what a model lacks there


def elasticity(
    simulator: MjcfSimulator,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[int],
) -> list[RobotEffect]:
    """Candidates of gears that give behind an encoder at the motor: a joint lags by compliance times the
    torque transmitted, slowly against the gear's own ringing, which moves bodies and sites beyond it."""
    model, data = simulator.model, mujoco.MjData(simulator.model)
    columns = simulator.map.columns
    seen = {n: m for n, m in columns.items() if m.thing in ("site", "body") and m.axis in ("x", "y", "z")}
    if not seen:
        return []
    moved = {log.name: {n: np.zeros((len(joints), len(log))) for n in seen} for log in recordings}
    jacobian = np.zeros((3, model.nv))
    dof = {j: int(model.jnt_dofadr[j]) for j in joints}
    for log, motion in zip(recordings, motions, strict=True):
        geared = {j: motion.torque[j] - _of_motor(model, motion, j) for j in joints}
        for i in range(len(log)):
            for j, position in motion.position.items():
                data.qpos[int(model.jnt_qposadr[j])] = position[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for name, mapped in seen.items():
                of = mujoco.mj_jacSite if mapped.thing == "site" else mujoco.mj_jacBody
                of(model, data, jacobian, None, object_id(model, mapped.thing, mapped.name))
                rate = jacobian["xyz".index(mapped.axis)]
                moved[log.name][name][:, i] = [rate[dof[j]] * geared[j][i] for j in joints]
    out = []
    for k, j in enumerate(joints):
        if all(np.abs(moved[log.name][n][k]).max() < LIGHT for log in recordings for n in seen):
            continue
        size, name = sizes_of(motions, j), name_of(model, "joint", j)

        def alter(window: Recording, channels: Channels, theta: Mapping[str, float], k: int = k) -> Channels:
            rows = slice(window.first, window.first + len(window))
            mine = moved[window.name]
            return {n: channels[n] - theta["compliance"] * mine[n][k, rows] for n in seen}

        compliance = {"compliance": Parameter(0.0, GIVES * size.reach / size.torque, "rad/(N m)", low=0.0)}
        says = f"gears of {name} give under load, behind the encoder"
        out.append(RobotEffect(f"joint:{name}.elasticity", says, compliance, alter=alter))
    return out


def _of_motor(model: Any, motion: Motion, joint: int) -> np.ndarray:
    """Torque (n,) [N m] that a joint's rotor and damping take, before what it moves."""
    dof = int(model.jnt_dofadr[joint])
    return model.dof_armature[dof] * motion.acceleration[joint] + model.dof_damping[dof] * motion.rate[joint]


class Sizes(NamedTuple):
    """Root mean squares of a joint's motion along the logs."""

    torque: float
    rate: float
    acceleration: float
    reach: float


def sizes_of(motions: Sequence[Motion], joint: int) -> Sizes:
    """Sizes of a joint's motion along all logs."""

    def rms(values: Iterable[np.ndarray], least: float = 1e-6) -> float:
        return max(float(np.sqrt(np.mean(np.concatenate([*values]) ** 2))), least)

    reach = rms(m.position[joint] - m.position[joint].mean() for m in motions)
    rate, acceleration = rms(m.rate[joint] for m in motions), rms(m.acceleration[joint] for m in motions)
    return Sizes(rms((m.torque[joint] for m in motions), 1e-9), rate, acceleration, reach)


SPAN = 2 * REACH  # chosen: s over which a motion is smoothed by a cubic, as a window's start is
OFTEN = 100.0  # limit: periods per turn, and rad/s of what comes and goes; SPAN smooths what is faster away


def periods(motions: Sequence[Motion], joint: int, scaled: bool) -> float:
    """How often per turn a joint's torque comes and goes most: a wave or, `scaled`, a share of the motor's.

    What motors give less what the motion takes, regressed on waves of the joint's angle next to what changes
    slowly with it (the periodogram of Lomb 1976 and Scargle 1982). 0 where the joint does not turn enough, or
    chance alone would show as much: SPAN makes as many samples one."""
    q, rate, torque, motor = (
        np.concatenate([getattr(m, name)[joint][m.rows] for m in motions])
        for name in ("position", "rate", "torque", "motor")
    )
    span, most = float(np.ptp(q)), OFTEN / max(1.0, float(np.median(np.abs(rate))))
    often = np.arange(max(2.0, np.pi / max(span, 1e-9)), most, np.pi / (4 * max(span, 1e-9)))
    if span * most < 4 * np.pi or not often.size:
        return 0.0
    slow = np.column_stack([q**0, q, np.sin(q), np.cos(q), rate, np.sign(rate), motor, motor * q])
    basis = np.linalg.qr(slow / np.maximum(np.abs(slow).max(0), 1e-12))[0]
    left = torque - motor
    left = left - basis @ (basis.T @ left)
    shares = np.zeros(often.size)
    for k, n in enumerate(often):
        pair = np.column_stack([np.cos(n * q), np.sin(n * q)])
        pair = pair * motor[:, None] if scaled else pair
        pair = pair - basis @ (basis.T @ pair)
        fitted = pair @ np.linalg.lstsq(pair, left, rcond=1e-6)[0]
        shares[k] = fitted @ fitted / max(float(left @ left), 1e-300)
    best = int(np.argmax(shares))
    independent = sum(np.ptp(m.t) for m in motions) / SPAN
    by_chance = often.size * max(1 - shares[best], 0.0) ** (0.5 * independent)
    return float(often[best]) if by_chance < ALARM else 0.0


@dataclass(frozen=True)
class Motion:
    """The motion along a log, by joint."""

    t: np.ndarray  # (n,) [s] of its samples
    rows: np.ndarray  # of which torques are computed, 100 a second at most
    position: dict[int, np.ndarray]
    rate: dict[int, np.ndarray]
    acceleration: dict[int, np.ndarray]
    torque: dict[int, np.ndarray]  # that it takes
    motor: dict[int, np.ndarray]  # that motors give


def motion_of(simulator: MjcfSimulator, log: Recording) -> Motion:
    """The motion along a log; what no column shows moves as in the model's own run, loops closed."""
    model, states = simulator.model, simulator.along(log)
    nq, seen = model.nq, {joint: log[column] for column, joint in simulator.joints.items()}
    for joint in np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE))).tolist():
        seen.setdefault(joint, states[:, 1 + int(model.jnt_qposadr[joint])])
    position, rate, acceleration = {}, {}, {}
    for joint, values in seen.items():
        position[joint], rate[joint], acceleration[joint] = smoothed(log.t, values)
    data = mujoco.MjData(model)
    torque, motor = ({j: np.zeros(len(log)) for j in position} for _ in range(2))
    rows = np.arange(0, len(log), max(1, round(len(log) / max(float(log.t[-1] - log.t[0]) * 100.0, 1.0))))
    for i in rows:
        data.qpos[:], data.qvel[:] = np.split(states[i, 1 : 1 + nq + model.nv], [nq])
        for j in position:
            q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            data.qpos[q], data.qvel[v], data.qacc[v] = position[j][i], rate[j][i], acceleration[j][i]
        for column, a in simulator.driven.items():
            data.ctrl[a] = np.nan_to_num(log[column][i])
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        for j in position:
            v = model.jnt_dofadr[j]
            torque[j][i], motor[j][i] = data.qfrc_inverse[v], data.qfrc_actuator[v]
    full, given = (
        {j: np.interp(log.t, log.t[rows], one[rows]) for j, one in each.items()} for each in (torque, motor)
    )
    return Motion(log.t, rows, position, rate, acceleration, full, given)


def smoothed(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, rate and acceleration (n,), by cubics over SPAN (Savitzky & Golay 1964)."""
    seen = np.isfinite(values)
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + 0.5 * step, step)
    even = np.interp(grid, t[seen], values[seen])
    width = min(max(7, 2 * round(SPAN / step / 2) + 1), (grid.size - 1) // 2 * 2 + 1)
    order = min(3, width - 1)
    return tuple(
        np.interp(t, grid, np.asarray(savgol_filter(even, width, order, deriv=d, delta=step)))
        for d in range(3)
    )
