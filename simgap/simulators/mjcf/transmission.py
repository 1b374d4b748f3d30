"""What MuJoCo's models lack and the recorded motion tells: a drive that carries the arm's weight, gears that
give under load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.model import MjcfSimulator
from simgap.simulators.mjcf.motion import Motion
from simgap.simulators.mjcf.runs import APPLIED
from simgap.simulators.mjcf.setting import name_of, object_id
from simgap.simulators.protocol import Channels, Parameter
from simgap.simulators.recording import Recording

LIGHT = 1e-6  # numerics: N m, m N m: what is less is nothing
GIVES = 0.01  # prior: of a joint's reach: by how much its gears usually give
SHARE = 0.03  # prior: of the torques that a joint shows: the usual size of what a model lacks there


def gravity_compensation(
    simulator: MjcfSimulator,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[int],
) -> list[RobotEffect]:
    """A drive that carries a share of the weights: torques against gravity along the recorded motion."""
    model, data = simulator.model, mujoco.MjData(simulator.model)
    carried: dict[str, np.ndarray] = {}
    for log, motion in zip(recordings, motions, strict=True):
        carried[log.name] = np.zeros((len(joints), len(log)))
        for i in range(len(log)):
            for j, position in motion.position.items():
                data.qpos[int(model.jnt_qposadr[j])] = position[i]
            data.qvel[:] = 0.0
            mujoco.mj_forward(model, data)
            carried[log.name][:, i] = [data.qfrc_bias[int(model.jnt_dofadr[j])] for j in joints]
    names = [f"{APPLIED}{name_of(model, 'joint', j)}" for j in joints]
    if all(np.abs(v).max(initial=0.0) < LIGHT for v in carried.values()):
        return []

    def act(log: Recording, theta: Mapping[str, float]) -> Recording:
        whole = carried[log.name][:, log.first : log.first + len(log)]
        before = [log.columns.get(n, np.zeros(len(log))) for n in names]
        return log.with_columns(
            {n: b + theta["share"] * w for n, b, w in zip(names, before, whole, strict=True)}
        )

    share = {"share": Parameter(0.0, 0.1, "1", low=-0.5, high=1.5)}
    says = "drives carry this share of the weights by themselves (gravity compensation)"
    return [RobotEffect("drive.gravity_compensation", says, share, command=act)]


def elasticity(
    simulator: MjcfSimulator,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[int],
) -> list[RobotEffect]:
    """Gears that give: behind an encoder at the motor, a joint lags by compliance times the torque that it
    transmits, which moves what is read of bodies and sites beyond it. Slow against the gear's own ringing, as
    motions are."""
    model, data = simulator.model, mujoco.MjData(simulator.model)
    columns = simulator.map.columns
    seen = {n: m for n, m in columns.items() if m.thing in ("site", "body") and m.axis in ("x", "y", "z")}
    if not seen:
        return []
    moved = {log.name: {n: np.zeros((len(joints), len(log))) for n in seen} for log in recordings}
    jacobian = np.zeros((3, model.nv))
    for log, motion in zip(recordings, motions, strict=True):
        for i in range(len(log)):
            for j, position in motion.position.items():
                data.qpos[int(model.jnt_qposadr[j])] = position[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for name, mapped in seen.items():
                of = mujoco.mj_jacSite if mapped.thing == "site" else mujoco.mj_jacBody
                of(model, data, jacobian, None, object_id(model, mapped.thing, mapped.name))
                rate = jacobian["xyz".index(mapped.axis)]
                moved[log.name][name][:, i] = [
                    rate[int(model.jnt_dofadr[j])] * (motion.torque[j][i] - _of_motor(model, motion, j, i))
                    for j in joints
                ]
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


def _of_motor(model: Any, motion: Motion, joint: int, row: int) -> float:
    """Torque that a joint's own rotor and damping take [N m], before what it moves."""
    dof = int(model.jnt_dofadr[joint])
    rotor, damping = float(model.dof_armature[dof]), float(model.dof_damping[dof])
    return rotor * float(motion.acceleration[joint][row]) + damping * float(motion.rate[joint][row])


class Sizes:
    """What a joint shows along the logs, root mean squares."""

    def __init__(self, torque: float, rate: float, acceleration: float, reach: float) -> None:
        self.torque, self.rate = max(torque, 1e-9), max(rate, 1e-6)
        self.acceleration, self.reach = max(acceleration, 1e-6), max(reach, 1e-6)


def sizes_of(motions: Sequence[Motion], joint: int) -> Sizes:
    """Sizes of one joint's motion along all logs."""
    rms = lambda values: float(np.sqrt(np.mean(np.concatenate(values) ** 2)))  # noqa: E731
    return Sizes(
        rms([m.torque[joint] for m in motions]),
        rms([m.rate[joint] for m in motions]),
        rms([m.acceleration[joint] for m in motions]),
        rms([m.position[joint] - m.position[joint].mean() for m in motions]),
    )
