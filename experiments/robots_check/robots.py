"""Robots from packages' wheels, without meshes and with slightly changed masses, and their motions.

pip download --no-deps --only-binary :all: -d DIR dm-control robosuite     # then unzip the wheels in DIR
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

LIKE: Any = mujoco
LONGEST = 0.005  # s; longest step of the diagnosing model's solver


@dataclass(frozen=True)
class Robot:
    """A robot: the path of its model in a folder of unzipped wheels; `driven`, the joint and command unit of
    each actuator; `read`, the recorded joints; `reach` [rad] and `rate` [Hz] of motions about the pose
    `about`; `seconds` of a log. `grip`: constant commands of actuators; `carried`: two slides that bring a
    body to a site, where it is gripped before a log begins; `without`: bodies that are removed; `step` [s] of
    the solver, if not the package's.
    """

    name: str
    file: str
    driven: Mapping[str, tuple[str, str]]
    read: tuple[str, ...]
    reach: float
    rate: float
    seconds: float
    about: Mapping[str, float] = field(default_factory=dict)
    grip: Mapping[str, float] = field(default_factory=dict)
    carried: tuple[str, str, str] | None = None
    without: tuple[str, ...] = ()
    step: float | None = None


UR5E = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
ROBOTS = (
    Robot(
        "pendulum",
        "dm_control/suite/pendulum.xml",
        {"torque": ("hinge", "Nm")},
        ("hinge",),
        0.2,
        0.7,
        4.0,
        {"hinge": np.pi},
    ),
    Robot(
        "reacher",
        "dm_control/suite/reacher.xml",
        {"shoulder": ("shoulder", "Nm"), "wrist": ("wrist", "Nm")},
        ("shoulder", "wrist"),
        0.6,
        0.6,
        2.5,
        {"wrist": 0.8},
    ),
    Robot(
        "acrobot",
        "dm_control/suite/acrobot.xml",
        {"elbow": ("elbow", "Nm")},
        ("shoulder", "elbow"),
        0.5,
        0.6,
        2.5,
        {"elbow": 0.5},
    ),
    Robot(
        "ur5e",
        "robosuite/models/assets/robots/ur5e/robot.xml",
        {f"torq_j{i + 1}": (f"{n}_joint", "Nm") for i, n in enumerate(UR5E)},
        tuple(f"{n}_joint" for n in UR5E),
        0.5,
        0.6,
        2.5,
        {"shoulder_lift_joint": -1.2, "elbow_joint": 1.4, "wrist_1_joint": -1.0, "wrist_2_joint": -1.5},
    ),
    Robot(
        "manipulator",
        "dm_control/suite/manipulator.xml",
        {"root": ("arm_root", "1"), "shoulder": ("arm_shoulder", "1"), "elbow": ("arm_elbow", "1"),
         "wrist": ("arm_wrist", "1")},
        ("arm_root", "arm_shoulder", "arm_elbow", "arm_wrist", "thumb", "thumbtip", "finger", "fingertip",
         "ball_x", "ball_z", "ball_y"),
        0.4,
        0.8,
        1.0,
        {"arm_root": 0.3, "arm_shoulder": 0.8, "arm_elbow": 0.8, "arm_wrist": 0.3},
        {"grasp": 0.4},
        ("ball_x", "ball_z", "grasp"),
        ("peg", "slot", "cup", "target_ball", "target_peg"),
        0.002,
    ),
)  # fmt: skip


def nominal_xml(robot: Robot, models: Path, rng: np.random.Generator) -> str:
    """The diagnosing model: the package's without meshes, with other masses and damping."""
    spec = LIKE.MjSpec.from_file(str(models / robot.file))
    for geom in list(spec.geoms):
        if geom.type == LIKE.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for name in robot.without:
        spec.delete(spec.body(name))
    for body in spec.bodies:
        if body.explicitinertial:
            share = rng.uniform(0.85, 1.15)
            body.mass *= share
            body.inertia = np.array(body.inertia) * share
    for joint in spec.joints:
        joint.damping = np.array(joint.damping) * rng.uniform(0.6, 1.6)
    spec.option.timestep = min(robot.step or spec.option.timestep, LONGEST)
    return spec.to_xml()


def map_toml(robot: Robot, noise: Mapping[str, float]) -> str:
    """The map of columns: commands by actuator, positions by joint with their `noise`."""
    units = {a: unit for a, (_, unit) in robot.driven.items()} | dict.fromkeys(robot.grip, "1")
    out = [f'[columns.u_{a}]\nactuator = "{a}"\nunit = "{unit}"\n' for a, unit in units.items()]
    out += [f'[columns.q_{j}]\njoint = "{j}"\nnoise = {noise[j]}\n' for j in robot.read]
    return "".join(out)
