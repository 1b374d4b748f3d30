"""What a cube does in the way of an arm's hand that moves as it was recorded: a plain Python simulator.

The hand's course is given by trial (`courses`), so that the arm's own gap (experiments/real/collins_hand.py)
is no part of the cube's. The fingers' meshes are not at hand and nobody says how far they were closed: a bar
across the hand stands in for their tips. Where it is, is fitted along, from a place at which it meets the
cube about when the fingers did. Nor did anyone measure what slides: both frictions are fitted along from
usual ones, as MuJoCo's 1, which the authors left in place, tips the cube over.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.real import collins_arm as arm
from experiments.real import collins_hand
from experiments.real.collins_arm import HAND, POSE, product
from simgap.robot_effects.readouts import rotated

CUBE = {a: f"cube_{a}" for a in ("x", "y", "z", "qw", "qx", "qy", "qz")}
SIDE, MASS, FLOOR = 0.075, 0.0884, 0.01  # m, kg, m: of the authors' model
LOWER = ("m1n6s300_link_finger_tip_2", "m1n6s300_link_finger_tip_3")
TIP = (0.044, -0.003, 0.0)  # m: of a finger's last link, from its joint, of the authors' model
RADIUS, HALF = 0.008, 0.03  # m: of the bar
HEAVY = 1e3  # kg: a hand that no cube slows
BEGIN, END = 13.6, 15.2  # s since the hand left its place: it rests before and the cube after
STILL = 0.15  # s at the beginning, whose means say where the cube is put
RATE = 50.0  # Hz of the prepared logs
STEP = 0.004  # s


class Cube:
    """The cube's pose `cube_*`; `courses`: by trial's file name times (n,) and the hand's poses (7, n)."""

    channels = {  # noqa: RUF012
        c: {"unit": "1" if a.startswith("q") else "m", "kind": "position"} for a, c in CUBE.items()
    }
    parameters = {  # noqa: RUF012
        "table.friction": {"nominal": 0.4, "sd": 0.3, "unit": "1", "low": 0.02, "high": 3.0, "fitted": True},
        "finger.friction": {"nominal": 0.4, "sd": 0.3, "unit": "1", "low": 0.02, "high": 3.0, "fitted": True},
        "contact.time": {"nominal": 0.02, "sd": 0.01, "unit": "s", "low": 0.005, "effect": "contact"},
        "contact.damping": {"nominal": 1.0, "sd": 0.5, "unit": "1", "low": 0.05, "effect": "contact"},
        "cube.mass": {"nominal": MASS, "sd": 0.01, "unit": "kg", "low": 0.02},
        "cube.side": {"nominal": SIDE, "sd": 0.002, "unit": "m", "low": 0.05},
        "table.height": {"nominal": FLOOR, "sd": 0.005, "unit": "m"},
        "finger.along": {"nominal": 0.0, "sd": 0.03, "unit": "m", "fitted": True},
        "finger.up": {"nominal": 0.04, "sd": 0.03, "unit": "m", "fitted": True},
    }
    poses = {"cube": CUBE}  # noqa: RUF012
    says = {  # noqa: RUF012
        "contact": "contacts yield with this time constant and damping ratio",
        "cube.mass": "the cube's mass",
        "cube.side": "the cube's side",
        "table.height": "the table stands higher or lower under the hand",
    }

    def __init__(self, courses: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
        self.courses = courses

    def simulate(self, parameters, recording):
        """The cube's pose at the recording's times, from where it was put at their beginning."""
        put = recording.t <= recording.t[0] + STILL
        first = np.array([recording[CUBE[a]][put].mean() for a in CUBE])
        values = tuple(parameters[n] for n in self.parameters)
        pose = _pushed(values, recording.t, *self.courses[recording.name], first[:2])
        turn = product(pose[3:], product(pose[3:, 0] * [1, -1, -1, -1], first[3:])[:, None])
        moved = first[:3, None] + pose[:3] - pose[:3, :1]
        turn = turn / np.linalg.norm(turn, axis=0)
        return dict(zip(CUBE.values(), [*moved, *turn], strict=True))


def fingertips() -> np.ndarray:
    """The middle (3,) between the tips of the two lower fingers in the hand's frame, fingers open [m]."""
    mujoco, model = arm.arm()
    data, hand = mujoco.MjData(model), model.body(HAND).id
    mujoco.mj_kinematics(model, data)
    ends = [data.xpos[k] + data.xmat[k].reshape(3, 3) @ TIP for k in (model.body(n).id for n in LOWER)]
    return data.xmat[hand].reshape(3, 3).T @ (np.mean(ends, 0) - data.xpos[hand])


@lru_cache(maxsize=64)
def scene(values: tuple[float, ...]) -> tuple[Any, Any]:
    """MuJoCo and a model: table, cube, and fingers that are carried by a heavy hand."""
    mujoco, _ = arm.arm()
    p = dict(zip(Cube.parameters, values, strict=True))
    spec, box = mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_BOX
    slip, soft = [0.005, 0.0001], [p["contact.time"], p["contact.damping"]]
    half, height = p["cube.side"] / 2, p["table.height"]
    spec.worldbody.add_geom(
        type=box,
        size=[2, 2, 0.02],
        pos=[0, 0, height - 0.02],
        friction=[p["table.friction"], *slip],
        solref=soft,
    )
    cube = spec.worldbody.add_body(name="cube", pos=[0, 0, height + half])
    cube.add_freejoint()
    # A pair takes the larger friction of the two: the cube's own is none, so that others' count.
    cube.add_geom(type=box, size=[half] * 3, mass=p["cube.mass"], friction=[1e-3, *slip], solref=soft)
    hand = spec.worldbody.add_body(
        name="hand", gravcomp=1.0, mass=HEAVY, inertia=[HEAVY] * 3, explicitinertial=True
    )
    hand.add_freejoint()
    across, middle = np.array([HALF, 0.0, 0.0]), fingertips()
    middle = middle + np.array([0.0, p["finger.up"], -p["finger.along"]])
    hand.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*(middle - across), *(middle + across)],
        size=[RADIUS, 0, 0], friction=[p["finger.friction"], *slip], solref=soft,
    )  # fmt: skip
    model = arm.solved(mujoco, spec.compile())
    model.opt.timestep = STEP
    return mujoco, model


def _pushed(
    values: tuple[float, ...], t: np.ndarray, given: np.ndarray, course: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """The cube's pose (7, n) at times t (n,), put `at` (2,), while the hand goes through `course` (7, m) at
    times `given` (m,)."""
    mujoco, model = scene(values)
    data = mujoco.MjData(model)
    data.qpos[:2] = at
    steps = max(2, round((t[-1] - t[0]) / STEP) + 1)
    times = t[0] + STEP * np.arange(steps)
    place, turn, pace, spin = _driven(times, given, course)
    out = np.empty((steps, 7))
    for i in range(steps):
        data.qpos[7:10], data.qpos[10:14] = place[i], turn[i]
        data.qvel[6:9], data.qvel[9:12] = pace[i], spin[i]
        out[i] = data.qpos[:7]
        mujoco.mj_step(model, data)
    return np.array([np.interp(t, times, out[:, k]) for k in range(7)])


def _driven(times: np.ndarray, t: np.ndarray, course: np.ndarray):
    """Places, turns and their rates (in the hand's frame: spins) of the hand at the solver's times."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    spline = CubicSpline(t, course[:3].T)
    turned = RotationSpline(t, Rotation.from_quat(course[[4, 5, 6, 3]].T))
    rotation = turned(times)
    quat = rotation.as_quat()[:, [3, 0, 1, 2]]
    return spline(times), quat, spline(times, 1), rotation.inv().apply(turned(times, 1))


def prepare(folder: Path, into: Path) -> tuple[list[Path], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Logs of the cube from BEGIN to END of a folder's real trials, and the hand's courses by name."""
    paths = arm.prepared(folder / "cubepush" / "real", into, [*POSE.values(), *CUBE.values()], RATE)
    courses = {}
    for path in paths:
        frame: Any = pd.read_csv(path)
        pose = link(frame.t.to_numpy(), np.array([frame[c] for c in POSE.values()]))
        since = frame.t - collins_hand.left(frame.t.to_numpy(), pose[:3])
        mine = ((since >= BEGIN) & (since < END)).to_numpy()
        courses[path.name] = (frame.t.to_numpy()[mine], pose[:, mine])
        frame[mine][["t", *CUBE.values()]].to_csv(path, index=False, float_format="%.7g")
    return paths, courses


def link(t: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Poses (7, n) of the hand's link by those of its marker: where that is on the link tells the trial's
    first second, in which all joints are at zero."""
    mujoco, model = arm.arm()
    data, hand = mujoco.MjData(model), model.body(HAND).id
    mujoco.mj_kinematics(model, data)
    begin = seen[:, t < 1.0].mean(1)
    back = data.xquat[hand] * [1, -1, -1, -1]
    marker = product(back, begin[3:] / np.linalg.norm(begin[3:]))
    turn = product(seen[3:], (marker * [1, -1, -1, -1])[:, None])
    off = rotated(back[:, None], begin[:3] - data.xpos[hand])[:, 0]
    return np.concatenate([seen[:3] - rotated(turn, off), turn])
