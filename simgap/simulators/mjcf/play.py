"""Play between a motor and its joint: two bodies, each free to move within the gap.

MuJoCo's joints are stiff behind their actuators. With play a joint is split: its rotor, friction and actuator
go to a motor of its own, and a tendon keeps motor and joint within half of the play of each other. The
encoder is on the joint's side. A motor is not seen, so where it is in the gap when a window begins is taken
from a free run along the whole log.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simgap.latest import latest
from simgap.simulators.mjcf.engine import FULL, mujoco
from simgap.simulators.mjcf.laws import MOTOR
from simgap.simulators.mjcf.runs import Runs, free_run
from simgap.simulators.mjcf.setting import Setting, changed_model, compiled, setting_of
from simgap.simulators.protocol import Channels, Job
from simgap.simulators.recording import Recording

WIDTH = ".width"  # suffix of the setting of a joint's play [rad or m]
KEPT = 64  # numerics: free runs that are kept
MOVES = ("damping", "frictionloss", "armature")  # what goes to the motor
LIGHT = 1e-6  # numerics: kg, kg m^2: the motor's body; its rotor is its joint's armature


@dataclass
class Played:
    """A model in which one joint has play."""

    model: Any
    runs: Runs
    settings: Mapping[str, Setting]
    name: str
    joint: int  # its number in the plain model
    logs: Mapping[str, Recording]  # by name
    width: str  # the setting of the play
    seen: Mapping[str, int]  # joint by position column
    known: dict[Any, Any] = field(default_factory=dict, repr=False)

    def __call__(
        self, jobs: Sequence[Job], first: np.ndarray, changed: Sequence[tuple[str, float]], nominal: Any
    ) -> list[Channels | None]:
        """All jobs' channels from states (B, size) of the `nominal` model; None of one that diverged."""
        width, nq, nv = dict(changed)[self.width], nominal.nq, nominal.nv
        q, v = int(nominal.jnt_qposadr[self.joint]), int(nominal.jnt_dofadr[self.joint])
        tendon = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_TENDON, f"{self.name}{WIDTH}")
        self.model.tendon_range[tendon] = (-0.5 * width, 0.5 * width)
        rest = tuple((n, x) for n, x in changed if n != self.width and n in self.settings)
        ahead = {n: self._ahead(self.logs[n], width) for n in {j.recording.name for j in jobs}}
        with changed_model(self.model, self.settings, rest):
            more = np.array([ahead[j.recording.name][j.recording.first] for j in jobs])
            at, rate = first[:, [1 + q]] + more[:, :1], first[:, [1 + nq + v]] + more[:, 1:]
            parts = np.split(first, [1 + nq, 1 + nq + nv], 1)
            own = np.concatenate([parts[0], at, parts[1], rate, parts[2]], 1)
            return self.runs([j.recording for j in jobs], own, tuple(changed))

    def _ahead(self, log: Recording, width: float) -> np.ndarray:
        """How far the motor is ahead of its joint, and faster, at a log's samples (n, 2)."""
        return latest(self.known, (log.name, width), lambda: self._run(log, width), KEPT)

    def _run(self, log: Recording, width: float) -> np.ndarray:
        m, data = self.model, self.runs.data[0]
        mujoco.mj_resetData(m, data)
        for column, joint in self.seen.items():
            data.qpos[int(m.jnt_qposadr[joint])] = log[column][np.isfinite(log[column])][0]
        pair = [int(m.joint(n).id) for n in (f"{self.name}{MOTOR}", self.name)]
        q, v = ([int(places[j]) for j in pair] for places in (m.jnt_qposadr, m.jnt_dofadr))
        data.qpos[q[0]] = data.qpos[q[1]]
        first = np.empty(mujoco.mj_stateSize(m, FULL))
        mujoco.mj_getState(m, data, first, FULL)
        state = free_run(m, data, log, first, self.runs.driven)
        ahead = state[:, [1 + q[0], 1 + m.nq + v[0]]] - state[:, [1 + q[1], 1 + m.nq + v[1]]]
        ahead[:, 0] = np.clip(ahead[:, 0], -0.5 * width, 0.5 * width)
        return np.where(np.isfinite(ahead).all(1, keepdims=True), ahead, 0.0)


def played(
    spec: Any, name: str, actuator: str, make: Callable[[Any], Runs], wanted: Sequence[str],
    logs: Mapping[str, Recording], seen: Mapping[str, int],
) -> Played | None:  # fmt: skip
    """Build the model with play in a joint.

    Args:
        spec: The MjSpec, which is changed.
        name, actuator: The joint, and the actuator that moves it.
        make: Makes the runs of a model.
        wanted: Settings that the model is to have.
        logs: By name.
        seen: Joint by position column.

    Returns:
        The model; None where the joint has no rotor that could move alone, or MuJoCo refuses it.
    """
    joint, body = spec.joint(name), spec.joint(name).parent
    if not joint.armature > 0:
        return None
    motor = body.parent.add_body(name=f"{name}{MOTOR}", pos=body.pos, quat=body.quat)
    motor.explicitinertial, motor.mass, motor.inertia = True, LIGHT, [LIGHT] * 3
    moved = {n: getattr(joint, n) for n in MOVES}
    motor.add_joint(name=f"{name}{MOTOR}", type=joint.type, axis=joint.axis, pos=joint.pos, **moved)
    for n, value in moved.items():
        setattr(joint, n, 0.0 * np.asarray(value) if np.ndim(value) else 0.0)
    spec.actuator(actuator).target = f"{name}{MOTOR}"
    stiff = {"limited": True, "solref_limit": [2 * float(spec.option.timestep), 1.0]}
    tendon = spec.add_tendon(name=f"{name}{WIDTH}", range=[-1.0, 1.0], **stiff)
    tendon.wrap_joint(f"{name}{MOTOR}", 1.0)
    tendon.wrap_joint(name, -1.0)
    try:
        model = compiled(spec)
    except ValueError:
        return None
    if int(model.joint(f"{name}{MOTOR}").id) != model.njnt - 1:
        return None  # the states of others would lie elsewhere
    settings = {}
    for one in wanted:
        head, _, attribute = one.rpartition(".")
        there = f"{head}{MOTOR}.{attribute}" if head == f"joint:{name}" and attribute in MOVES else one
        settings[one] = setting_of(model, there)
    number = int(model.joint(name).id)
    return Played(model, make(model), settings, name, number, logs, f"joint:{name}{WIDTH}", seen)
