"""What of a MuJoCo model is offered as a cause: its joints, bodies, contacts, actuators and its own options.

Usual sizes are shares of what the robot shows along the logs: torques by inverse dynamics of the smoothed
motion. Friction that depends on state beyond what MuJoCo has acts as torques along the recorded motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.model import APPLIED, MjcfSimulator
from simgap.simulators.mjcf.motion import Motion, motion_of
from simgap.simulators.mjcf.settable import setting_of
from simgap.simulators.mjcf.setting import Setting, names_of
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording

SHARE = 0.03  # prior: of the torques that a joint shows: the usual size of what a model lacks there
SIZE = 0.1  # prior: of a value that the model states, likewise
GEOMS = 4  # chosen: pairs of touching geoms, those that touch most, whose contact is offered


def offered(
    simulator: MjcfSimulator, recordings: Sequence[Recording], named: Sequence[str]
) -> list[RobotEffect]:
    """Give the simulator its parameters, and the candidates beyond them."""
    motions = [motion_of(simulator, log) for log in recordings]
    model = simulator.model
    parameters: dict[str, Parameter] = {}
    settings: dict[str, Setting] = {}
    says: dict[str, str] = {}

    def offer(
        name: str,
        sd: float,
        low: float = -np.inf,
        high: float = np.inf,
        effect: str | None = None,
        told: str = "",
    ) -> None:
        setting = setting_of(model, name)
        nominal = setting.get(model)
        if not sd > 0 or not np.isfinite(sd):
            return
        settings[name] = setting
        low = min(low, nominal)
        parameters[name] = Parameter(nominal, float(sd), setting.unit, low, high, effect)
        says[effect or name] = told or f"{name} is not as the model has it"

    moving = [j for j in range(model.njnt) if int(model.jnt_type[j]) in HINGES and _name(model, "joint", j)]
    told = [j for j in moving if j in simulator.joints.values()]
    for j in told:
        name, size = _name(model, "joint", j), _sizes(motions, j)
        for attribute, scale in (
            ("damping", size.torque / size.rate),
            ("frictionloss", size.torque),
            ("armature", size.torque / size.acceleration),
            ("stiffness", size.torque / size.reach),
        ):
            setting = setting_of(model, f"joint:{name}.{attribute}")
            offer(
                setting.name,
                max(SHARE * scale, SIZE * abs(setting.get(model))),
                low=0.0,
                told=f"{SAYS[attribute]} of {name}",
            )
    for name in names_of(model, "actuator"):
        a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if model.actuator_gainprm[a, 0] and simulator.driven and a in simulator.driven.values():
            offer(f"actuator:{name}.gain", SIZE, low=-0.9, told=f"gain of {name} (of a servo, its stiffness)")
            if model.actuator_biasprm[a, 2]:
                offer(
                    f"actuator:{name}.damping",
                    SIZE * abs(float(model.actuator_biasprm[a, 2])),
                    low=0.0,
                    told=f"velocity gain of {name}",
                )
        if model.actuator_forcelimited[a] and a in simulator.driven.values():
            offer(
                f"actuator:{name}.limit",
                SIZE * float(model.actuator_forcerange[a, 1]),
                low=1e-9,
                told=f"saturation of {name}",
            )
    for b in _moved_bodies(model, [*told, *simulator.free]):
        name = _name(model, "body", b)
        if not name or model.body_mass[b] <= 0:
            continue
        size = float(np.sqrt(model.body_inertia[b].sum() / model.body_mass[b]))
        offer(
            f"body:{name}.mass",
            SIZE * float(model.body_mass[b]),
            low=1e-3 * float(model.body_mass[b]),
            told=f"mass (and inertia) of {name}",
        )
        for axis in "xyz":
            offer(
                f"body:{name}.com_{axis}",
                SIZE * size,
                effect=f"body:{name}.com",
                told=f"centre of mass of {name}",
            )
        children = [c for c in range(model.nbody) if model.body_parentid[c] == b and c != b]
        if not children or not any(model.body_jntnum[c] for c in children):
            offer(f"body:{name}.payload", SIZE * _largest(model), low=0.0, told=f"a load at {name}")
        first = int(model.body_jntadr[b])
        chained = (
            model.body_jntnum[b] and int(model.jnt_type[first]) in HINGES and model.body_parentid[b] != 0
        )
        if chained and np.linalg.norm(model.body_pos[b]) > 1e-6:
            offer(f"body:{name}.length", 0.01, low=-0.5, told=f"length of the link before {name}")
    if np.linalg.norm(model.opt.gravity) > 0:
        for axis in ("tilt_x", "tilt_y"):
            offer(f"option.{axis}", 0.01, effect="gravity.direction", told="the base is tilted")
    offer("option.timestep", 0.5, low=-1.1, high=1.0, told="the simulator's own time step, relative")
    offer(
        "option.integrator",
        0.5,
        low=0.0,
        high=1.1,
        told="the simulator's integrator: this share of another's result",
    )
    if simulator.touching:
        offer(
            "option.iterations",
            0.3,
            low=0.0,
            high=1.0,
            told="iterations of the simulator's solver: ten times as many",
        )
    for g in _touching(simulator, recordings):
        name = _name(model, "geom", g)
        if not name:
            continue
        offer(
            f"geom:{name}.friction",
            SIZE * max(float(model.geom_friction[g, 0]), 0.1),
            low=0.0,
            told=f"friction of {name}",
        )
        offer(
            f"geom:{name}.time_constant",
            SIZE * float(model.geom_solref[g, 0]),
            low=1e-4,
            effect=f"geom:{name}.stiffness",
            told=f"stiffness and damping of {name}'s contact",
        )
        offer(f"geom:{name}.damping_ratio", 2 * SIZE, low=0.05, effect=f"geom:{name}.stiffness")
        offer(f"geom:{name}.size", 0.01, low=-0.5, told=f"size of {name}")
    for name in named:
        if name not in parameters:
            nominal = setting_of(model, name).get(model)
            offer(name, SIZE * abs(nominal) if nominal else 0.01)
    simulator.parameters, simulator.settings, simulator.says = parameters, settings, says
    simulator.__post_init__()
    simulator.prepare(recordings)
    return _state_friction(model, simulator, recordings, motions, told)


HINGES = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
SAYS = {
    "damping": "viscous friction",
    "frictionloss": "Coulomb friction",
    "armature": "rotor inertia",
    "stiffness": "a spring (cable) on",
}


def _name(model: Any, kind: str, number: int) -> str:
    return mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), number) or ""


class _Size:
    """What a joint shows along the logs, root mean squares."""

    def __init__(self, torque: float, rate: float, acceleration: float, reach: float) -> None:
        self.torque, self.rate = max(torque, 1e-9), max(rate, 1e-6)
        self.acceleration, self.reach = max(acceleration, 1e-6), max(reach, 1e-6)


def _sizes(motions: Sequence[Motion], joint: int) -> _Size:
    rms = lambda values: float(np.sqrt(np.mean(np.concatenate(values) ** 2)))  # noqa: E731
    return _Size(
        rms([m.torque[joint] for m in motions]),
        rms([m.rate[joint] for m in motions]),
        rms([m.acceleration[joint] for m in motions]),
        rms([m.position[joint] - m.position[joint].mean() for m in motions]),
    )


def _largest(model: Any) -> float:
    return float(np.max(model.body_mass[1:])) if model.nbody > 1 else 1.0


def _moved_bodies(model: Any, joints: Sequence[int]) -> list[int]:
    """Bodies that these joints move themselves (not through a further joint)."""
    own = {int(model.jnt_bodyid[j]) for j in joints}
    return [b for b in range(1, model.nbody) if b in own]


def _touching(simulator: MjcfSimulator, recordings: Sequence[Recording]) -> list[int]:
    """Geoms that touch along the recorded motion, those of moving bodies that touch most."""
    if not simulator.touching:
        return []
    count: dict[int, int] = {}
    for log in recordings:
        for g in (g for pairs in simulator.touched(log) for pair in pairs for g in pair):
            count[g] = count.get(g, 0) + 1
    moving = {int(simulator.model.jnt_bodyid[j]) for j in (*simulator.free, *simulator.joints.values())}
    ranked = sorted(count, key=lambda g: (int(simulator.model.geom_bodyid[g]) not in moving, -count[g]))
    return ranked[:GEOMS]


def _state_friction(
    model: Any,
    simulator: MjcfSimulator,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[int],
) -> list[RobotEffect]:
    """Friction that depends on load, speed or direction, as torques along the recorded motion."""
    by_log = {log.name: motion for log, motion in zip(recordings, motions, strict=True)}
    out = []
    for j in joints:
        name, size = _name(model, "joint", j), _sizes(motions, j)
        turning = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        unit = "N m" if turning else "N"
        usual = SHARE * size.torque
        still = 0.02 * size.rate  # below this the direction of motion is not told

        def way(log: Recording, joint: int = j, still: float = still) -> np.ndarray:
            return np.tanh(by_log[log.name].rate[joint] / still)

        def load(log: Recording, theta: Mapping[str, float], joint: int = j, way=way) -> np.ndarray:
            return -theta["share"] * np.abs(by_log[log.name].torque[joint]) * way(log)

        def skew(log: Recording, theta: Mapping[str, float], joint: int = j, way=way) -> np.ndarray:
            return -theta["skew"] * np.abs(way(log))

        def stribeck(log: Recording, theta: Mapping[str, float], joint: int = j, way=way) -> np.ndarray:
            rate = by_log[log.name].rate[joint]
            return -theta["extra"] * np.exp(-((rate / theta["speed"]) ** 2)) * way(log)

        def drag(log: Recording, theta: Mapping[str, float], joint: int = j) -> np.ndarray:
            rate = by_log[log.name].rate[joint]
            return -theta["coefficient"] * rate * np.abs(rate)

        share = {"share": Parameter(0.0, SHARE, "1", low=0.0)}
        out += [
            _applied(name, "load_friction", "friction in proportion to the torque transmitted", share, load),
            _applied(
                name,
                "direction_friction",
                "friction larger one way than the other",
                {"skew": Parameter(0.0, usual, unit)},
                skew,
            ),
            _applied(
                name,
                "stribeck",
                "friction larger near standstill, by extra exp(-(rate / speed)^2)",
                {
                    "extra": Parameter(0.0, usual, unit, low=0.0),
                    "speed": Parameter(
                        0.3 * size.rate, 0.1 * size.rate, "rad/s" if turning else "m/s", low=0.03 * size.rate
                    ),
                },
                stribeck,
            ),
            _applied(
                name,
                "quadratic_drag",
                "drag in proportion to the rate's square",
                {"coefficient": Parameter(0.0, usual / size.rate**2, f"{unit} s^2/rad^2", low=0.0)},
                drag,
            ),
        ]
    return out


def _applied(joint: str, what: str, says: str, parameters: dict[str, Parameter], torque) -> RobotEffect:
    column = f"{APPLIED}{joint}"

    def act(log: Recording, theta: Mapping[str, float]) -> Recording:
        before = log.columns.get(column, np.zeros(len(log)))
        return log.with_columns({column: before + torque(log, theta)})

    return RobotEffect(f"joint:{joint}.{what}", says, parameters, command=act)
