"""True robots: the diagnosing model with another integrator and faults, run by a controller and recorded.

None of the product's effects is used: faults act on the compiled model, in the loop, or on the record.
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
NOISE = 5e-4  # rad, of hinges
PLACE_NOISE = 1e-4  # m, of slides
FINER = 3  # the world's step is the model's over this
LOGS = 3
WINDOW = 40  # rows; window for a fault's detectability
PACE = 2.5  # Hz: of the controller
HELD, SETTLED = 1.0, 0.5  # s; a body is held while the grip closes on it, then settles until the log begins


@dataclass(frozen=True)
class Fault:
    """A fault: its `kind`, the joint or actuator, its `size`, and the causes that name it `right`ly."""

    kind: str
    thing: str
    size: float
    right: tuple[str, ...]


@dataclass
class World:
    """A model with faults of its record and commands; `torque` acts in addition to the actuators."""

    model: Any
    command: list[Callable[[np.ndarray, np.ndarray], np.ndarray]]
    read: dict[str, list[Callable[[np.ndarray, np.ndarray], np.ndarray]]]
    torque: list[Callable[[Any, float], None]]


def usual(robot: Robot, xml: str) -> dict[str, tuple[float, float, float]]:
    """Rms torque, rate and acceleration of each joint along a motion of the plain model."""
    rng = np.random.default_rng(0)
    model = LIKE.MjModel.from_xml_string(xml)
    shown = run(robot, World(model, [], {}, []), motion(robot, rng), measure=True)
    return shown["usual"]


def motion(robot: Robot, rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Desired angles of the driven joints: three sines each, about a pose."""
    count = len(robot.driven)
    rates = 2 * np.pi * robot.rate * rng.uniform(0.4, 1.7, (count, 3))
    sizes = robot.reach * rng.uniform(0.2, 0.6, (count, 3))
    phases = rng.uniform(0, 2 * np.pi, (count, 3))
    about = np.array([robot.about.get(j, 0.0) for j, _ in robot.driven.values()])
    return lambda t: about + np.sum(sizes * np.sin(rates * t + phases), 1)


def noise_of(robot: Robot, xml: str) -> dict[str, float]:
    """Noise sd of one sample, by recorded joint."""
    model = LIKE.MjModel.from_xml_string(xml)
    slide = int(LIKE.mjtJoint.mjJNT_SLIDE)
    return {j: PLACE_NOISE if int(model.joint(j).type[0]) == slide else NOISE for j in robot.read}


def run(
    robot: Robot,
    world: World,
    wanted: Callable[[float], np.ndarray],
    measure: bool = False,
    rate: float = RATE,
    states: list[np.ndarray] | None = None,
) -> dict:
    """A log: `t`, commands as logged, positions without noise; the state at every row goes into `states`."""
    model, data = world.model, LIKE.MjData(world.model)
    actuators = [model.actuator(a).id for a in robot.driven]
    dofs = [int(model.jnt_dofadr[model.joint(j).id]) for j, _ in robot.driven.values()]
    places = [int(model.jnt_qposadr[model.joint(j).id]) for j, _ in robot.driven.values()]
    read = [int(model.jnt_qposadr[model.joint(j).id]) for j in robot.read]
    for place, (joint, _) in zip(places, robot.driven.values(), strict=True):
        data.qpos[place] = robot.about.get(joint, 0.0)
    for name, command in robot.grip.items():
        data.ctrl[model.actuator(name).id] = command
    LIKE.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    steps = round(1 / rate / model.opt.timestep)
    before = round((HELD + SETTLED) * rate) if robot.carried else 0
    rows = round(robot.seconds * rate)
    t, log = np.arange(-before, rows) / rate, np.zeros((rows, len(read)))
    commands = np.zeros((t.size, len(actuators)))
    shown = {j: ([], [], []) for j, _ in robot.driven.values()}
    limits = np.where(model.actuator_ctrllimited[actuators], model.actuator_ctrlrange[actuators, 1], np.inf)
    gear = model.actuator_gear[actuators, 0]
    for i in range(-before, rows):
        log[max(i, 0)] = data.qpos[read]
        if states is not None and i >= 0:
            states.append(np.concatenate([data.qpos, data.qvel]))
        LIKE.mj_fullM(model, inertia, data.qM) if hasattr(data, "qM") else LIKE.mj_fullM(model, data, inertia)
        mass = np.maximum(np.diag(inertia)[dofs], 1e-6)
        off, pace = wanted(max(i, 0) / rate) - data.qpos[places], 2 * np.pi * PACE
        pull = mass * (pace**2 * off - 2 * pace * data.qvel[dofs]) + model.dof_damping[dofs] * pace * off
        now = before + i
        commands[now] = np.clip((pull + data.qfrc_bias[dofs]) / gear, -limits, limits)
        past = commands[now : now + 1]
        if world.command:
            past = commands[: now + 1].copy()
        for act in world.command:
            past = act(t[: now + 1], past)
        data.ctrl[actuators] = past[-1]
        for _ in range(steps):
            if i < -round(SETTLED * rate):
                _hold(robot, model, data)
            data.qfrc_applied[:] = 0.0
            for push in world.torque:
                push(data, i / rate)
            LIKE.mj_step(model, data)
        if measure and i >= 0:
            for (joint, _), d, k in zip(robot.driven.values(), dofs, range(len(dofs)), strict=True):
                shown[joint][0].append(past[-1][k] * gear[k])
                shown[joint][1].append(data.qvel[d])
                shown[joint][2].append(data.qacc[d])
    t, given = t[before:], commands[before:]
    out: dict[str, Any] = {"t": t}
    out |= {f"u_{a}": given[:, k] for k, a in enumerate(robot.driven)}
    out |= {f"u_{a}": np.full(rows, command) for a, command in robot.grip.items()}
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


def nats(
    robot: Robot, xml: str, faults: list[Fault], sizes: Mapping[str, tuple[float, float, float]],
    wanted: Callable[[float], np.ndarray], noise: Mapping[str, float],
) -> list[float]:  # fmt: skip
    """Detectability of each fault in a log [nats] if all else is known: half the squared deviations, in units
    of the noise, of windows restarted from the true states without the fault, straight lines left out."""
    states: list[np.ndarray] = []
    shown = run(robot, world_of(xml, faults, sizes), wanted, states=states)
    faulty = _replayed(robot, world_of(xml, faults, sizes), shown, states)
    out = []
    for k in range(len(faults)):
        without = _replayed(robot, world_of(xml, faults[:k] + faults[k + 1 :], sizes), shown, states)
        total = 0.0
        for joint, sd in noise.items():
            for one in np.split(faulty[joint] - without[joint], np.arange(WINDOW, len(states), WINDOW)):
                line = np.stack([np.ones(one.size), np.arange(one.size)], 1)
                left = one - line @ np.linalg.lstsq(line, one, rcond=None)[0]
                total += 0.5 * float(left @ left) / sd**2
        out.append(total)
    return out


def _replayed(robot: Robot, world: World, shown: Mapping, states: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Positions as read, by joint, in windows begun from these states and driven by the logged commands."""
    model, data = world.model, LIKE.MjData(world.model)
    actuators = [model.actuator(a).id for a in robot.driven]
    read = [int(model.jnt_qposadr[model.joint(j).id]) for j in robot.read]
    for name, command in robot.grip.items():
        data.ctrl[model.actuator(name).id] = command
    t, commands = shown["t"], np.stack([shown[f"u_{a}"] for a in robot.driven], 1)
    for act in world.command:
        commands = act(t, commands)
    log, steps = np.zeros((t.size, len(read))), round((t[1] - t[0]) / model.opt.timestep)
    for i in range(t.size):
        if i % WINDOW == 0:
            data.time = t[i]
            data.qpos[:], data.qvel[:] = np.split(states[i], [model.nq])
            data.qacc_warmstart[:] = 0.0
        log[i] = data.qpos[read]
        data.ctrl[actuators] = commands[i]
        for _ in range(steps):
            data.qfrc_applied[:] = 0.0
            for push in world.torque:
                push(data, t[i])
            LIKE.mj_step(model, data)
    out = {}
    for k, joint in enumerate(robot.read):
        out[joint] = log[:, k]
        for act in world.read.get(joint, []):
            out[joint] = act(t, out[joint])
    return out


def _hold(robot: Robot, model: Any, data: Any) -> None:
    """Keep a carried body where the grip closes on it."""
    if robot.carried is None:
        return
    along, up, site = robot.carried
    for joint, value in ((along, data.site(site).xpos[0]), (up, data.site(site).xpos[2])):
        data.qpos[int(model.joint(joint).qposadr[0])] = value
        data.qvel[int(model.joint(joint).dofadr[0])] = 0.0


def world_of(xml: str, faults: list[Fault], sizes: Mapping[str, tuple[float, float, float]]) -> World:
    """The true world: the model with another integrator, a finer step, and faults."""
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
