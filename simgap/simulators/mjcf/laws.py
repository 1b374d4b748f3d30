"""Laws that MuJoCo lacks and that depend on the state: friction by load, speed or direction, drag, cogging,
fading drives.

Friction is a constraint that holds a joint at rest; its limit is set before each step,

    limit = frictionloss + share |m + b| / 2 + extra exp(-(w / speed)^2) + skew sign(w),

with w the joint's rate, m the torque of its motors and b that of gravity and the other joints' motion: what
presses on the gears from either side, in balance the torque that they transmit (model M4 of Duclusaud et al.,
Extended friction models for the physics simulation of servo actuators, 2024). A fading drive gives f (1 -
fade |f| / most), with most the largest force it can give. Cogging adds c cos(n q) + s sin(n q) to a joint at
q, and ripple that times m. A step uses the quantities of the one before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, exp, sin
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import FULL, mujoco
from simgap.simulators.mjcf.setting import FADE, OF_FRICTION, UNEVEN, most_of, object_id

MOTOR = ":motor"  # suffix of a joint's name: its motor, where that is a body of its own


@dataclass(frozen=True)
class _Friction:
    dof: int
    share: float
    skew: float
    extra: float
    speed: float
    drag: float


@dataclass(frozen=True)
class Laws:
    """Laws that act in a model."""

    friction: tuple[_Friction, ...]  # of joints
    # by drive: actuator, fade over its largest force, the joint's number, its torque by a unit force
    fading: tuple[tuple[int, float, int, float], ...]
    # by joint: coordinate, velocity, periods per turn, both amplitudes, whether of the motor's torque
    uneven: tuple[tuple[int, int, float, float, float, bool], ...]

    def __bool__(self) -> bool:
        return bool(self.friction or self.fading or self.uneven)

    @classmethod
    def of(cls, model: Any, changed: Sequence[tuple[str, float]]) -> Laws:
        """The laws of the changed settings."""
        joints: dict[str, dict[str, float]] = {}
        fading, uneven = [], list[tuple[int, int, float, float, float, bool]]()
        for name, value in changed:
            head, _, attribute = name.rpartition(".")
            kind, _, thing = head.partition(":")
            if kind == "joint" and attribute in (*OF_FRICTION, *UNEVEN):
                joints.setdefault(thing, {})[attribute] = value
            elif kind == "actuator" and attribute == FADE:
                a = object_id(model, "actuator", thing)
                dof = int(model.jnt_dofadr[int(model.actuator_trnid[a, 0])])
                by = value / max(most_of(model, a), 1e-9)
                fading.append((a, by, dof, float(model.actuator_gear[a, 0])))
        friction = []
        for joint, own in joints.items():
            j = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"{joint}{MOTOR}")
            j = object_id(model, "joint", joint) if j < 0 else j
            place, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            share, skew, extra, speed, drag = (float(own.get(n, 0.0)) for n in OF_FRICTION)
            if share or skew or extra or drag:
                friction.append(_Friction(dof, share, skew, extra, max(speed, 1e-9), drag))
            for scaled in (False, True):
                often, even, odd = (own.get(n, 0.0) for n in UNEVEN[3 * scaled : 3 + 3 * scaled])
                if even or odd:
                    uneven.append((place, dof, often, even, odd, scaled))
        return cls(tuple(friction), tuple(fading), tuple(uneven))


def run(model: Any, data: Any, laws: Laws, first: np.ndarray, control: np.ndarray) -> np.ndarray:
    """Run a model with laws.

    Args:
        model, data: MuJoCo's.
        laws: What acts.
        first: Full states (B, size) to run from.
        control: Controls (B, steps, actuators).

    Returns:
        Sensors (B, steps, sensors), as of `mujoco.rollout`.
    """
    out = np.empty((*control.shape[:2], model.nsensordata))
    plain, nu, step = np.array(model.dof_frictionloss), model.nu, mujoco.mj_step
    # Plain numbers and views of memory, several times as fast as elements and rows of arrays.
    friction = [(f.dof, float(plain[f.dof]), 0.5 * f.share, *vars(f).values()) for f in laws.friction]
    seen = model.dof_frictionloss, data.qpos, data.qvel, data.qfrc_actuator, data.qfrc_bias
    given = data.actuator_force, data.qfrc_applied, data.ctrl, data.sensordata
    views: list[Any] = [memoryview(one) for one in (*seen, *given)]
    limit, angle, rate, motor, bias, force, pushed, ctrl, sensed = views
    applied = {*(f.dof for f in laws.friction if f.drag), *(dof for _, _, dof, _ in laws.fading)}
    applied |= {one[1] for one in laws.uneven}
    try:
        for b in range(len(first)):
            model.dof_frictionloss[:] = plain
            mujoco.mj_resetData(model, data)
            mujoco.mj_setState(model, data, first[b], FULL)
            data.ctrl[:] = control[b, 0]
            mujoco.mj_forward(model, data)
            data.qacc_warmstart[:] = 0.0
            asked, told = memoryview(control[b].ravel()), []
            for k in range(0, control[b].size, nu) if nu else range(control.shape[1]):
                for dof in applied:
                    pushed[dof] = 0.0
                for d, most, half, _, _, skew, extra, speed, drag in friction:
                    if half:
                        most += half * abs(motor[d] + bias[d])
                    if extra:
                        share = rate[d] / speed
                        most += extra * exp(-share * share)
                    if skew:
                        most += skew * ((rate[d] > 0) - (rate[d] < 0))
                    limit[d] = most if most > 0 else 0.0
                    if drag:
                        pushed[d] -= drag * rate[d] * abs(rate[d])
                for a, by, dof, gear in laws.fading:
                    pushed[dof] -= by * abs(force[a]) * force[a] * gear
                for q, d, often, even, odd, scaled in laws.uneven:
                    wave = even * cos(often * angle[q]) + odd * sin(often * angle[q])
                    pushed[d] += wave * motor[d] if scaled else wave
                ctrl[:] = asked[k : k + nu]
                step(model, data)
                told.append(sensed.tobytes())
            out[b] = np.frombuffer(b"".join(told)).reshape(out[b].shape)
    finally:
        model.dof_frictionloss[:] = plain
    return out
