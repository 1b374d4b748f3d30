"""Friction that depends on load, speed or direction, which MuJoCo lacks, as torques along the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from simgap.robot_effects.base import RobotEffect
from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.model import MjcfSimulator
from simgap.simulators.mjcf.motion import Motion
from simgap.simulators.mjcf.runs import APPLIED
from simgap.simulators.mjcf.setting import name_of
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording

SHARE = 0.03  # prior: of the torques that a joint shows: the usual size of what a model lacks there


def state_friction(
    simulator: MjcfSimulator,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[int],
) -> list[RobotEffect]:
    """Friction that depends on load, speed or direction, as torques along the recorded motion."""
    by_log = {log.name: motion for log, motion in zip(recordings, motions, strict=True)}
    model, out = simulator.model, []
    for j in joints:
        name, size = name_of(model, "joint", j), sizes_of(motions, j)
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
