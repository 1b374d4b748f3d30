"""Faults: how each is planted, its usual size, and the diagnoses that count as right.

`outside` ones are of no candidate's family: the right answers are `unknown`, or a remainder that is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from experiments.robots_check.robots import Robot
from experiments.robots_check.worlds import Fault, World

LIKE: Any = mujoco
Sizes = Mapping[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Kind:
    """`plant(world, fault, sizes)`; `share`: smallest and largest size drawn, of what a joint usually shows
    or as it is; `on` what; `right` names with {j} joint, {a} actuator, {b} body."""

    plant: Callable[[World, Fault, Sizes], None]
    share: tuple[float, float]
    on: str
    right: tuple[str, ...]
    signed: bool = False
    outside: bool = False


def _dof(world: World, joint: str) -> int:
    return int(world.model.jnt_dofadr[world.model.joint(joint).id])


def _damping(world: World, fault: Fault, sizes: Sizes) -> None:
    torque, rate, _ = sizes[fault.thing]
    world.model.dof_damping[_dof(world, fault.thing)] += fault.size * torque / rate


def _friction(world: World, fault: Fault, sizes: Sizes) -> None:
    world.model.dof_frictionloss[_dof(world, fault.thing)] += fault.size * sizes[fault.thing][0]


def _armature(world: World, fault: Fault, sizes: Sizes) -> None:
    torque, _, acceleration = sizes[fault.thing]
    world.model.dof_armature[_dof(world, fault.thing)] += fault.size * torque / acceleration


def _spring(world: World, fault: Fault, sizes: Sizes) -> None:
    joint = world.model.joint(fault.thing).id
    world.model.jnt_stiffness[joint] += fault.size * sizes[fault.thing][0] / REACH


def _mass(world: World, fault: Fault, sizes: Sizes) -> None:
    body = world.model.body(_body(world, fault.thing)).id
    world.model.body_mass[body] *= 1 + fault.size
    world.model.body_inertia[body] *= 1 + fault.size


def _body(world: World, joint: str) -> str:
    return world.model.body(int(world.model.joint(joint).bodyid[0])).name


def _gain(world: World, fault: Fault, sizes: Sizes) -> None:
    world.model.actuator_gainprm[world.model.actuator(fault.thing).id, 0] *= 1 + fault.size


def _tilt(world: World, fault: Fault, sizes: Sizes) -> None:
    gravity = world.model.opt.gravity
    gravity[:] = gravity + np.cross([0.0, 1.0, 0.0], gravity) * fault.size


def _index(world: World, actuator: str) -> int:
    return int(world.model.actuator(actuator).id)


def _offset(world: World, fault: Fault, sizes: Sizes) -> None:
    k, by = _index(world, fault.thing), fault.size * _command(world, fault, sizes)
    world.command.append(lambda t, u: u + by * (np.arange(u.shape[1]) == k))


def _dead_band(world: World, fault: Fault, sizes: Sizes) -> None:
    k, band = _index(world, fault.thing), fault.size * _command(world, fault, sizes)

    def act(t: np.ndarray, u: np.ndarray) -> np.ndarray:
        out = np.array(u)
        out[:, k] = np.sign(u[:, k]) * np.maximum(np.abs(u[:, k]) - band, 0.0)
        return out

    world.command.append(act)


def _command(world: World, fault: Fault, sizes: Sizes) -> float:
    """Usual size of an actuator's command."""
    actuator = world.model.actuator(fault.thing)
    joint = world.model.joint(int(actuator.trnid[0])).name
    return sizes.get(joint, next(iter(sizes.values())))[0] / float(actuator.gear[0])


def _delay(world: World, fault: Fault, sizes: Sizes) -> None:
    def act(t: np.ndarray, u: np.ndarray) -> np.ndarray:
        late = np.array([np.interp(t - fault.size, t, u[:, k]) for k in range(u.shape[1])]).T
        return late

    world.command.append(act)


def _read(change: Callable[[Fault, np.ndarray, np.ndarray], np.ndarray]):
    def plant(world: World, fault: Fault, sizes: Sizes) -> None:
        world.read.setdefault(fault.thing, []).append(lambda t, q: change(fault, t, q))

    return plant


def _cogging(world: World, fault: Fault, sizes: Sizes) -> None:
    """A torque that ripples with the angle."""
    dof, size = _dof(world, fault.thing), fault.size * sizes[fault.thing][0]
    place = int(world.model.jnt_qposadr[world.model.joint(fault.thing).id])

    def push(data: Any, t: float) -> None:
        data.qfrc_applied[dof] += size * np.sin(9.0 * data.qpos[place])

    world.torque.append(push)


def _gusts(world: World, fault: Fault, sizes: Sizes) -> None:
    """External pushes, independent of angle and command."""
    dof, size = _dof(world, fault.thing), fault.size * sizes[fault.thing][0]
    world.torque.append(
        lambda data, t: data.qfrc_applied.__setitem__(
            dof, data.qfrc_applied[dof] + size * np.sin(2 * np.pi * 1.3 * t) * np.sin(2 * np.pi * 0.37 * t)
        )
    )


def _swinging_read(fault: Fault, t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """A sensor on a bracket that rings at 6 Hz."""
    w, d, out, rate = 2 * np.pi * 6.0, 0.05, np.array(q), 0.0
    value = q[0]
    for i in range(1, q.size):
        for _ in range(10):
            h = (t[i] - t[i - 1]) / 10
            rate += h * (w**2 * (q[i] - value) - 2 * d * w * rate)
            value += h * rate
        out[i] = value
    return q + fault.size * (out - q)


REACH = 0.5  # rad: of a usual motion
JOINT, ACTUATOR, READ, WHOLE = "joint", "actuator", "read", "whole"
FAULTS: dict[str, Kind] = {
    "damping": Kind(_damping, (0.06, 0.3), JOINT, ("joint:{j}.damping",)),
    "friction": Kind(_friction, (0.06, 0.3), JOINT, ("joint:{j}.frictionloss",)),
    "armature": Kind(_armature, (0.06, 0.3), JOINT, ("joint:{j}.armature",)),
    "spring": Kind(_spring, (0.06, 0.3), JOINT, ("joint:{j}.stiffness",)),
    "mass": Kind(_mass, (0.08, 0.3), JOINT, ("body:{b}.mass",)),
    "gain": Kind(
        _gain, (0.06, 0.25), ACTUATOR, ("actuator:{a}.gain", "command:u_{a}.gain", "command:u_{a}.fade"), True
    ),
    "offset": Kind(_offset, (0.06, 0.3), ACTUATOR, ("command:u_{a}.offset",), True),
    "dead_band": Kind(_dead_band, (0.06, 0.3), ACTUATOR, ("command:u_{a}.dead_band",)),
    "delay": Kind(_delay, (0.006, 0.03), WHOLE, ("command.delay",)),
    "tilt": Kind(_tilt, (0.02, 0.08), WHOLE, ("gravity.direction",), True),
    "read_gain": Kind(
        _read(lambda f, t, q: (1 + f.size) * q), (0.02, 0.1), READ, ("readout:q_{j}.gain",), True
    ),
    "read_bias": Kind(_read(lambda f, t, q: q + f.size), (0.03, 0.15), READ, ("readout:q_{j}.bias",), True),
    "read_lag": Kind(
        _read(lambda f, t, q: np.interp(t - f.size, t, q)), (0.006, 0.03), READ, ("readout:q_{j}.lag",)
    ),
    "cogging": Kind(_cogging, (0.15, 0.5), JOINT, ("joint:{j}.cogging",), outside=True),
    "gusts": Kind(_gusts, (0.15, 0.5), JOINT, (), outside=True),
    "ringing_sensor": Kind(_read(_swinging_read), (0.3, 1.0), READ, (), outside=True),
}


def drawn(robot: Robot, world: World, kind: str, rng: np.random.Generator) -> Fault:
    """A fault of a kind on a joint or actuator of the robot, its size log-uniform."""
    found = FAULTS[kind]
    size = float(np.exp(rng.uniform(*np.log(found.share)))) * (rng.choice([-1, 1]) if found.signed else 1)
    actuator = str(rng.choice(list(robot.driven)))
    joint = robot.driven[actuator][0]
    thing = {JOINT: joint, ACTUATOR: actuator, READ: joint, WHOLE: ""}[found.on]
    names = {"j": joint, "a": actuator, "b": _body(world, joint)}
    # With a single joint, a late reading is equivalent to a late command.
    late = ("command.delay",) if kind == "read_lag" and len(robot.read) == 1 else ()
    return Fault(kind, thing, size, (*(r.format(**names) for r in found.right), *late))
