"""True robots: the diagnosing model integrated otherwise, with faults, run by a controller and recorded.

Nothing of the product's effects is used: faults act on the compiled model, in the loop, or on the record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from experiments.robots_check.robots import Robot

LIKE: Any = mujoco
RATE = 100.0  # Hz of logs
NOISE = 5e-4  # rad
FINER = 3  # the world's step is the model's over this
LOGS = 3
PACE = 2.5  # Hz: of the controller


@dataclass(frozen=True)
class Fault:
    """One thing wrong: `kind`, on which joint or actuator, its `size`, the causes that name it `right`ly."""

    kind: str
    thing: str
    size: float
    right: tuple[str, ...]


@dataclass
class World:
    """A model, with what of the record and the commands is wrong; `torque` acts besides the actuators."""

    model: Any
    command: list[Callable[[np.ndarray, np.ndarray], np.ndarray]]
    read: dict[str, list[Callable[[np.ndarray, np.ndarray], np.ndarray]]]
    torque: list[Callable[[Any, float], None]]


def usual(robot: Robot, xml: str) -> dict[str, tuple[float, float, float]]:
    """By joint, rms of torque, rate and acceleration along a motion of the plain model."""
    rng = np.random.default_rng(0)
    model = LIKE.MjModel.from_xml_string(xml)
    shown = run(robot, World(model, [], {}, []), motion(robot, rng), measure=True)
    return shown["usual"]


def motion(robot: Robot, rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Wanted angles of the driven joints: about a pose, three sines each."""
    count = len(robot.driven)
    rates = 2 * np.pi * robot.rate * rng.uniform(0.4, 1.7, (count, 3))
    sizes = robot.reach * rng.uniform(0.2, 0.6, (count, 3))
    phases = rng.uniform(0, 2 * np.pi, (count, 3))
    about = np.array([robot.about.get(j, 0.0) for j, _ in robot.driven.values()])
    return lambda t: about + np.sum(sizes * np.sin(rates * t + phases), 1)


def run(
    robot: Robot,
    world: World,
    wanted: Callable[[float], np.ndarray],
    measure: bool = False,
    rate: float = RATE,
) -> dict:
    """A log: `t`, commands as logged, positions without noise."""
    model, data = world.model, LIKE.MjData(world.model)
    actuators = [model.actuator(a).id for a in robot.driven]
    dofs = [int(model.jnt_dofadr[model.joint(j).id]) for j, _ in robot.driven.values()]
    places = [int(model.jnt_qposadr[model.joint(j).id]) for j, _ in robot.driven.values()]
    read = [int(model.jnt_qposadr[model.joint(j).id]) for j in robot.read]
    for place, (joint, _) in zip(places, robot.driven.values(), strict=True):
        data.qpos[place] = robot.about.get(joint, 0.0)
    LIKE.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    steps = round(1 / rate / model.opt.timestep)
    rows = round(robot.seconds * rate)
    t, log, commands = np.arange(rows) / rate, np.zeros((rows, len(read))), np.zeros((rows, len(dofs)))
    shown = {j: ([], [], []) for j, _ in robot.driven.values()}
    limits = np.where(model.actuator_ctrllimited[actuators], model.actuator_ctrlrange[actuators, 1], np.inf)
    gear = model.actuator_gear[actuators, 0]
    for i in range(rows):
        log[i] = data.qpos[read]
        LIKE.mj_fullM(model, inertia, data.qM) if hasattr(data, "qM") else LIKE.mj_fullM(model, data, inertia)
        mass = np.maximum(np.diag(inertia)[dofs], 1e-6)
        off, pace = wanted(t[i]) - data.qpos[places], 2 * np.pi * PACE
        pull = mass * (pace**2 * off - 2 * pace * data.qvel[dofs]) + model.dof_damping[dofs] * pace * off
        commands[i] = np.clip((pull + data.qfrc_bias[dofs]) / gear, -limits, limits)
        past = commands[: i + 1]
        for act in world.command:
            past = act(t[: i + 1], past)
        data.ctrl[actuators] = past[-1]
        for _ in range(steps):
            data.qfrc_applied[:] = 0.0
            for push in world.torque:
                push(data, t[i])
            LIKE.mj_step(model, data)
        if measure:
            for (joint, _), d, k in zip(robot.driven.values(), dofs, range(len(dofs)), strict=True):
                shown[joint][0].append(past[-1][k] * gear[k])
                shown[joint][1].append(data.qvel[d])
                shown[joint][2].append(data.qacc[d])
    out: dict[str, Any] = {"t": t}
    out |= {f"u_{a}": commands[:, k] for k, a in enumerate(robot.driven)}
    for k, joint in enumerate(robot.read):
        values = log[:, k]
        for act in world.read.get(joint, []):
            values = act(t, values)
        out[f"q_{joint}"] = values
    if measure:
        out["usual"] = {
            j: tuple(max(float(np.sqrt(np.mean(np.square(v)))), 1e-6) for v in each)
            for j, each in shown.items()
        }
    return out


def world_of(xml: str, faults: list[Fault], sizes: Mapping[str, tuple[float, float, float]]) -> World:
    """The true world: the model by another integrator at a finer step, and its faults."""
    from experiments.robots_check.faults import FAULTS

    model = LIKE.MjModel.from_xml_string(xml)
    model.opt.integrator = LIKE.mjtIntegrator.mjINT_IMPLICIT
    model.opt.timestep /= FINER
    world = World(model, [], {}, [])
    for fault in faults:
        FAULTS[fault.kind].plant(world, fault, sizes)
    if any(f.kind in ("payload", "mass", "armature") for f in faults):
        LIKE.mj_setConst(model, LIKE.MjData(model))
    return world
