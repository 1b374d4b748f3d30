"""Collins, Howard and Leitner's arm and the controller around it, for whichever joints a task moves.

Their controller is P on every joint at 20 Hz with a limit of speed, into velocity servos. The hand's pose is
given as cameras see it that stand where the base may be turned, and with the marker's own orientation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

ARM = Path(__file__).resolve().parent / "collins_arm.xml"
HAND = "m1n6s300_link_6"
POSE = {a: f"ee_{a}" for a in ("x", "y", "z", "qw", "qx", "qy", "qz")}
CHANNELS = {c: {"unit": "1" if a.startswith("q") else "m", "kind": "position"} for a, c in POSE.items()}
JOINTS = 6
TICK, STEP, SHOWN = 0.05, 0.002, 0.01  # s: controller, solver, what is kept of the motion
SAYS = {
    "servo_slip": "velocity servos are stiffer (below 1) or softer than modelled",
    "gravity_compensation": "the drives hold this share of the arm's weight",
    "speed_limit": "the controller's limit of speed",
    "ramp": "commanded speed goes from 0 to the limit in this time and no faster",
    "controller_gain": "the controller's P gain",
    "elasticity": "the links swing behind their drives with this period and damping",
    "gear_ratio": "joint angles = (1 + ratio) times the drive's",
    "target_clock": "targets follow each other later or sooner than they should",
    "base": "the base stands turned in the cameras' frame",
}


def parameters(geared: Sequence[int]) -> dict[str, dict[str, Any]]:
    """What may be otherwise than the authors' model has it; of the `geared` joints (from 0) their zeros and
    ratios too."""
    one = {"unit": "1", "low": 0.0}
    zero = {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "joint_zero"}
    gear = {"nominal": 0.0, "sd": 0.01, "unit": "1", "effect": "gear_ratio"}
    return {
        "servo_slip": {"nominal": 1.0, "sd": 0.3, "unit": "1", "low": 0.02},
        "gravity_compensation": {"nominal": 0.0, "sd": 0.3, **one, "high": 1.2},
        "speed_limit": {"nominal": 30.0, "sd": 1.5, "unit": "deg/s", "low": 5.0},
        "ramp": {"nominal": 0.0, "sd": 0.1, "unit": "s", "low": 0.0, "high": 2.0},
        "controller_gain": {"nominal": 10.0, "sd": 3.0, "unit": "1/s", "low": 0.5, "high": 18.0},
        "elasticity.period": {"nominal": 0.0, "sd": 0.1, "unit": "s", "low": 0.0, "effect": "elasticity"},
        "elasticity.damping": {"nominal": 0.3, "sd": 0.15, **one, "effect": "elasticity"},
        "friction": {"nominal": 0.0, "sd": 0.5, "unit": "N m", "low": 0.0},
        "viscous": {"nominal": 0.0, "sd": 1.0, "unit": "N m s/rad", "low": 0.0},
        "payload": {"nominal": 0.0, "sd": 0.1, "unit": "kg", "low": 0.0},
        **{f"joint_zero.{k + 1}": dict(zero) for k in geared},
        **{f"gear_ratio.{k + 1}": dict(gear) for k in geared},
        "target_clock": {"nominal": 0.0, "sd": 0.01, "unit": "1", "low": -0.5},
        "base.tilt_x": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "base"},
        "base.tilt_y": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "base"},
        "base.yaw": {"nominal": 0.0, "sd": 0.02, "unit": "rad", "effect": "base"},
    }


@lru_cache(maxsize=1)
def arm() -> tuple[Any, Any]:
    """The MuJoCo module and the authors' arm alone."""
    from simgap.simulators.mjcf.engine import mujoco

    model = mujoco.MjModel.from_xml_path(str(ARM))
    return mujoco, solved(mujoco, model)


def solved(mujoco: Any, model: Any) -> Any:
    """The model with the step and integrator that it is run with here."""
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return model


def driven(
    p: Mapping[str, float],
    lasts: float,
    moved: Sequence[int],
    target: Callable[[float], np.ndarray],
    step: float = STEP,
) -> np.ndarray:
    """Joint angles (n, nq) every SHOWN s for `lasts` s, of the authors' controller and model.

    `target(time)`: angles [rad] that the `moved` joints are sent to, by the clock of `target_clock`;
    `step` [s]: the solver's."""
    mujoco, model = arm()
    model.opt.timestep = step
    kept = {
        n: np.array(getattr(model, n))
        for n in ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_damping", "body_mass")
    }
    gravity, moved = np.array(model.opt.gravity), list(moved)
    try:
        model.actuator_gainprm[:JOINTS] /= p["servo_slip"]
        model.actuator_biasprm[:JOINTS] /= p["servo_slip"]
        model.dof_frictionloss[moved] = p["friction"]
        model.dof_damping[moved] += p["viscous"]
        model.body_mass[model.body(HAND).id] += p["payload"]
        model.opt.gravity[:] = gravity * (1 - p["gravity_compensation"])
        data, out = mujoco.MjData(model), []
        limit = np.deg2rad(p["speed_limit"])
        jump = limit * TICK / max(p["ramp"], TICK)
        speed, shown = np.zeros(JOINTS), round(SHOWN / step)
        for tick in range(round(lasts / TICK)):
            goal = np.zeros(JOINTS)
            goal[moved] = target(tick * TICK / (1 + p["target_clock"]) + 1e-9)
            wanted = np.clip(p["controller_gain"] * (goal - data.qpos[:JOINTS]), -limit, limit)
            # Without a ramp the command jumps as it likes; with one, by `jump` a tick.
            speed = wanted if p["ramp"] <= 0 else speed + np.clip(wanted - speed, -jump, jump)
            data.ctrl[:JOINTS] = speed
            for _ in range(round(TICK / SHOWN)):
                out.append(np.array(data.qpos))
                mujoco.mj_step(model, data, shown)
    finally:
        for name, value in kept.items():
            getattr(model, name)[:] = value
        model.opt.gravity[:] = gravity
    return np.array(out)


def course(p: Mapping[str, float], angles: np.ndarray, moved: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and unit quaternions (n, 4) of the hand, in the cameras' frame, where drives go through
    `angles` (n, nq)."""
    angles, moved = np.array(angles), list(moved)
    angles[:, moved] = swung(angles[:, moved], p["elasticity.period"], p["elasticity.damping"])
    for joint in moved:
        ratio, zero = (p.get(f"{name}.{joint + 1}", 0.0) for name in ("gear_ratio", "joint_zero"))
        angles[:, joint] = (1 + ratio) * angles[:, joint] + zero
    mujoco, model = arm()
    data, hand = mujoco.MjData(model), model.body(HAND).id
    place, turn = np.empty((len(angles), 3)), np.empty((len(angles), 4))
    for i, q in enumerate(angles):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        place[i], turn[i] = data.xpos[hand], data.xquat[hand]
    turn *= np.cumprod(np.where(np.sum(turn * np.roll(turn, 1, 0), 1) < 0, -1.0, 1.0))[:, None]
    return stood(place, turn, p)


def swung(angles: np.ndarray, period: float, damping: float) -> np.ndarray:
    """Links (n, 2) behind their drives: q'' = w^2 (drive - q) + 2 d w (drive' - q'), w = 2 pi / period, each
    step exact for a drive that moves evenly."""
    if period < 1e-3:
        return angles
    from scipy.linalg import expm

    w = 2 * np.pi / period
    matrix = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    step = expm(matrix * SHOWN)
    off = np.zeros((2, angles.shape[1]))  # link less drive, and its rate
    out, rate = np.array(angles), np.gradient(angles, SHOWN, axis=0)
    for i in range(1, len(angles)):
        off[1] -= rate[i] - rate[i - 1]
        off = step @ off
        out[i] = angles[i] + off[0]
    return out


def stood(place: np.ndarray, turn: np.ndarray, p) -> tuple[np.ndarray, np.ndarray]:
    """The course as cameras see it when the base stands turned."""
    half = 0.5 * np.array([p["base.tilt_x"], p["base.tilt_y"], p["base.yaw"]])
    quat = np.array([np.sqrt(1 - half @ half), *half])
    rows = product(quat[:, None], turn.T)
    axis = quat[1:]
    once = np.cross(axis, place)
    return place + 2 * (quat[0] * once + np.cross(axis, once)), rows.T


def seen(recording: Any, place: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
    """The hand's channels at the recording's times, its first recorded orientation being the marker's."""
    times = np.arange(len(place)) * SHOWN
    since = recording.t - recording.t[0]
    out = {POSE[a]: np.interp(since, times, place[:, k]) for k, a in enumerate("xyz")}
    first = np.array([recording[POSE[a]][0] for a in ("qw", "qx", "qy", "qz")])
    quat = np.array([np.interp(since, times, turn[:, k]) for k in range(4)])
    quat = product(quat, product(turn[0] * [1, -1, -1, -1], first)[:, None])
    quat = quat / np.linalg.norm(quat, axis=0)
    return out | {POSE[a]: quat[k] for k, a in enumerate(("qw", "qx", "qy", "qz"))}


def product(a: Any, b: Any) -> np.ndarray:
    """Of quaternions (4,) or (4, n)."""
    from simgap.robot_effects.readouts import product

    return product(np.asarray(a, float), np.asarray(b, float))


def prepared(folder: Path, into: Path, columns: Sequence[str], rate: float, since: float = 0.2) -> list[Path]:
    """Real trials as logs: from `since` s on (before 0.2 s the cameras settle), means over 1 / rate."""
    import pandas as pd

    out = []
    for path in sorted(folder.glob("real_*.csv")):
        frame: Any = pd.read_csv(path)
        frame = frame[frame.t >= since]
        frame = frame.groupby((frame.t * rate + 1e-6).astype(int))[["t", *columns]].mean()
        out.append(into / path.name)
        frame.to_csv(out[-1], index=False, float_format="%.7g")
    return out
