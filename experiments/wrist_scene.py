"""Recordings by a gripper with a wrist sensor, made from simulated two-finger trials with their truth.

The hand hangs on the sensor with a tool of known mass, turned about the vertical and tilting a little
as it goes; the sensor stands askew on it and has an offset. What a lab would record of that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from hmmseg.io.rig import Rig, direction, parse_rig
from hmmseg.io.task import parse_task
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block
from simgap.world.simulate import SimulatedTrial, simulate_trials

G = 9.80665
PADS = {"normal_stiffness": 4000.0, "shear_stiffness": 2500.0}
BLOCKS = {"a": Block(0.9, 0.031, 0.024), "b": Block(0.5, 0.042, 0.028)}
TASK = parse_task({
    "objects": {"a": {"on": "b"}, "b": {"on": "ground"}},
    "moves": [{"object": "a", "to": "ground"}, {"object": "b", "to": "a"}],
})  # fmt: skip


@dataclass(frozen=True)
class Setup:
    """A lab's setup; see hmmseg.io.rig for the names."""

    mass: float = 0.7
    reaction: bool = False
    axes: tuple[str, str, str] = ("y", "x", "-z")
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heading: float = 0.0  # rad about the vertical
    tilt: float = 0.0  # rad, slowly varying
    frame: str = "sensor"
    noise: float = 0.005  # N
    position_noise: float = 2e-5  # m
    drift: float = 0.0  # N/s along the vertical
    rate: float = 50.0
    said: dict = field(default_factory=dict)


def performances(count: int = 2, rate: float = 50.0, seed: int = 0) -> list[SimulatedTrial]:
    """Trials at an arm's pace."""
    rig = parse_rig({"rate": rate, "gravity": G, "fingertip": PADS})
    slow = OperatorSettings(pace=(0.6, 0.7))
    return simulate_trials(TASK, rig, [BLOCKS] * count, list(range(seed, seed + count)), slow)


def wrist_rig(setup: Setup, **gripper) -> Rig:
    """The rig of a setup, with the given entries under [gripper]."""
    said = {"position": ["px", "py", "pz"], "opening": "gap", "wrench": ["Fx", "Fy", "Fz"],
            "closing": "y", "frame": setup.frame} | gripper  # fmt: skip
    if setup.tilt or setup.heading:
        said["quaternion"] = ["qx", "qy", "qz", "qw"]
    return parse_rig({"gravity": G, "fingertip": PADS, "gripper": said})


def wrist_recording(simulated: SimulatedTrial, setup: Setup, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of one trial as this lab records it."""
    rng = np.random.default_rng(seed)
    fine, motion = simulated.t, simulated.motion
    t = np.arange(int(fine[-1] * setup.rate)) / setup.rate
    middle = motion.position.mean(axis=1)
    n = len(fine)
    place = np.stack([np.zeros(n), middle[:, 0], middle[:, 1]], axis=1)
    acceleration = np.gradient(np.gradient(place, fine, axis=0), fine, axis=0)
    acceleration = _averaged(acceleration, 20)  # an arm is stiffer than the fingers that were simulated
    net = motion.force.sum(axis=1)
    force = np.stack([np.zeros(n), net[:, 0], net[:, 1]], axis=1)
    heading = Rotation.from_euler("z", setup.heading)
    place, acceleration, force = (heading.apply(v) for v in (place, acceleration, force))
    sway = setup.tilt * np.sin(2 * np.pi * fine / 3.0)
    turned = heading * Rotation.from_euler("xyz", np.stack([0.5 * sway, 0.7 * sway, 0 * sway], axis=1))
    weight = setup.mass * (acceleration + np.array([0, 0, G]))
    does = weight + force
    if setup.frame == "sensor":
        sensor = np.stack([direction(axis) for axis in setup.axes])
        does = turned.inv().apply(does) @ sensor.T
    reading = (-does if setup.reaction else does) + np.asarray(setup.offset)
    reading = _averaged(reading, max(1, int(1000 / setup.rate / 2)))
    quaternion = turned.as_quat()
    columns = {"t": t, "gap": motion.position[:, 1, 0] - motion.position[:, 0, 0]}
    columns |= {f"p{axis}": place[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"F{axis}": reading[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"q{axis}": quaternion[:, k] for k, axis in enumerate("xyzw")}
    out = {k: v if k == "t" else np.interp(t, fine, v) for k, v in columns.items()}
    for name in out:
        if name[0] in "pg":
            out[name] = out[name] + setup.position_noise * rng.normal(size=t.size)
        elif name[0] == "F":
            out[name] = out[name] + setup.noise * rng.normal(size=t.size)
    out["Fz"] = out["Fz"] + setup.drift * t
    return out


def _averaged(values: np.ndarray, width: int) -> np.ndarray:
    kernel = np.ones(width) / width
    return np.stack(
        [np.convolve(np.pad(c, width, "edge"), kernel, "same")[width:-width] for c in values.T], axis=1
    )
