"""An arm moves two joints out and back twice: a plain Python simulator around its authors' MuJoCo model.

    python -m experiments.real.collins FOLDER              # writes experiments/results/collins_twojoint.json
    python -m experiments.real.collins FOLDER --prepare DIR
    hmmseg diagnose DIR/*.csv --simulator experiments/real/collins.py:TwoJoint

FOLDER holds twojoint/real/real_*.csv (Collins, Howard, Leitner: a Kinova Mico2, its hand's pose seen by
cameras). The authors' controller is P on every joint at 20 Hz with a limit of speed, into velocity servos;
their simulated trial is met to 0.5 mm. Every real trial was started by hand, and markers were moved between
sessions, so each log has a shift in time and an offset of the marker of its own.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

HERE = Path(__file__).resolve().parent
POSE = {a: f"ee_{a}" for a in ("x", "y", "z", "qw", "qx", "qy", "qz")}
MOVED = (1, 4)  # joints
TARGETS = np.deg2rad([(-90.0, -90.0), (0.0, 0.0), (-90.0, 90.0), (0.0, 0.0)])
EVERY = 5.0  # s between targets
TICK, STEP, SHOWN = 0.05, 0.002, 0.01  # s: controller, solver, what is kept of the motion
LASTS = 24.0  # s
RATE = 20.0  # Hz of the prepared logs


def _parameters():
    one = {"unit": "1", "low": 0.0}
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
        "joint_zero.2": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "joint_zero"},
        "joint_zero.5": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "joint_zero"},
        "gear_ratio.2": {"nominal": 0.0, "sd": 0.01, "unit": "1", "effect": "gear_ratio"},
        "gear_ratio.5": {"nominal": 0.0, "sd": 0.01, "unit": "1", "effect": "gear_ratio"},
        "target_clock": {"nominal": 0.0, "sd": 0.01, "unit": "1", "low": -0.5},
        "base.tilt_x": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "base"},
        "base.tilt_y": {"nominal": 0.0, "sd": 0.01, "unit": "rad", "effect": "base"},
        "base.yaw": {"nominal": 0.0, "sd": 0.02, "unit": "rad", "effect": "base"},
    }


class TwoJoint:
    """The hand's pose `ee_*`; nothing is commanded but the four targets, which every trial has alike."""

    channels = {  # noqa: RUF012
        c: {"unit": "1" if a.startswith("q") else "m", "kind": "position"} for a, c in POSE.items()
    }
    parameters = _parameters()
    poses = {"ee": POSE}  # noqa: RUF012
    by_log = {  # noqa: RUF012
        "shift": {"nominal": 1.2, "sd": 0.3, "unit": "s"},
        "offset": {"nominal": 0.0, "sd": 0.005, "unit": "m"},
    }
    says = {  # noqa: RUF012
        "servo_slip": "velocity servos are stiffer (below 1) or softer than modelled",
        "gravity_compensation": "the drives hold this share of the arm's weight",
        "speed_limit": "the controller's limit of speed",
        "ramp": "commanded speed goes from 0 to the limit in this time and no faster",
        "controller_gain": "the controller's P gain",
        "elasticity": "the links swing behind their drives with this period and damping",
        "gear_ratio": "joint angles = (1 + ratio) times the drive's",
        "target_clock": "targets follow each other later or sooner than every 5 s",
        "base": "the base stands turned in the cameras' frame",
    }

    def simulate(self, parameters, recording):
        """The pose at the recording's times, the hand's first recorded orientation being the marker's."""
        place, turn = _course(tuple(parameters[n] for n in self.parameters))
        times = np.arange(len(place)) * SHOWN
        since = recording.t - recording.t[0]
        out = {POSE[a]: np.interp(since, times, place[:, k]) for k, a in enumerate("xyz")}
        seen = np.array([recording[POSE[a]] for a in ("qw", "qx", "qy", "qz")])
        quat = np.array([np.interp(since, times, turn[:, k]) for k in range(4)])
        quat = _product(quat, _product(turn[0] * [1, -1, -1, -1], seen[:, 0])[:, None])
        quat = quat / np.linalg.norm(quat, axis=0)
        return out | {POSE[a]: quat[k] for k, a in enumerate(("qw", "qx", "qy", "qz"))}


@lru_cache(maxsize=1)
def _model():
    from simgap.simulators.mjcf.engine import mujoco

    model = mujoco.MjModel.from_xml_path(str(HERE / "collins_arm.xml"))
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return mujoco, model


@lru_cache(maxsize=256)
def _course(values: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and unit quaternions (n, 4) of the hand every SHOWN s, in the cameras' frame."""
    p = dict(zip(TwoJoint.parameters, values, strict=True))
    angles = _driven(p)
    angles[:, MOVED] = _swung(angles[:, MOVED], p["elasticity.period"], p["elasticity.damping"])
    for k, joint in zip((2, 5), MOVED, strict=True):
        angles[:, joint] = (1 + p[f"gear_ratio.{k}"]) * angles[:, joint] + p[f"joint_zero.{k}"]
    mujoco, model = _model()
    data, hand = mujoco.MjData(model), model.body("m1n6s300_link_6").id
    place, turn = np.empty((len(angles), 3)), np.empty((len(angles), 4))
    for i, q in enumerate(angles):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        place[i], turn[i] = data.xpos[hand], data.xquat[hand]
    turn *= np.cumprod(np.where(np.sum(turn * np.roll(turn, 1, 0), 1) < 0, -1.0, 1.0))[:, None]
    return _stood(place, turn, p)


def _driven(p) -> np.ndarray:
    """Joint angles (n, nq) every SHOWN s, of the authors' controller and model."""
    mujoco, model = _model()
    kept = {
        n: np.array(getattr(model, n))
        for n in ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_damping", "body_mass")
    }
    gravity = np.array(model.opt.gravity)
    try:
        model.actuator_gainprm[:6] /= p["servo_slip"]
        model.actuator_biasprm[:6] /= p["servo_slip"]
        model.dof_frictionloss[list(MOVED)] = p["friction"]
        model.dof_damping[list(MOVED)] += p["viscous"]
        model.body_mass[model.body("m1n6s300_link_6").id] += p["payload"]
        model.opt.gravity[:] = gravity * (1 - p["gravity_compensation"])
        data, out = mujoco.MjData(model), []
        limit = np.deg2rad(p["speed_limit"])
        jump = limit * TICK / max(p["ramp"], TICK)
        speed, shown = np.zeros(6), round(SHOWN / STEP)
        for tick in range(round(LASTS / TICK)):
            stage = min(int(tick * TICK / (EVERY * (1 + p["target_clock"])) + 1e-9), len(TARGETS) - 1)
            target = np.zeros(6)
            target[list(MOVED)] = TARGETS[stage]
            wanted = np.clip(p["controller_gain"] * (target - data.qpos[:6]), -limit, limit)
            # Without a ramp the command jumps as it likes; with one, by `jump` a tick.
            speed = wanted if p["ramp"] <= 0 else speed + np.clip(wanted - speed, -jump, jump)
            data.ctrl[:6] = speed
            for _ in range(round(TICK / SHOWN)):
                out.append(np.array(data.qpos))
                mujoco.mj_step(model, data, shown)
    finally:
        for name, value in kept.items():
            getattr(model, name)[:] = value
        model.opt.gravity[:] = gravity
    return np.array(out)


def _swung(angles: np.ndarray, period: float, damping: float) -> np.ndarray:
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


def _stood(place: np.ndarray, turn: np.ndarray, p) -> tuple[np.ndarray, np.ndarray]:
    """The course as cameras see it when the base stands turned."""
    half = 0.5 * np.array([p["base.tilt_x"], p["base.tilt_y"], p["base.yaw"]])
    quat = np.array([np.sqrt(1 - half @ half), *half])
    rows = _product(quat[:, None], turn.T)
    axis = quat[1:]
    once = np.cross(axis, place)
    return place + 2 * (quat[0] * once + np.cross(axis, once)), rows.T


def _product(a, b):
    from simgap.robot_effects.readout_pose import product

    return product(np.asarray(a, float), np.asarray(b, float))


def prepare(folder: Path, into: Path) -> list[Path]:
    """The real trials as logs: without their first 0.2 s, means over 1 / RATE, signs of turns continuous."""
    out = []
    for path in sorted((folder / "twojoint" / "real").glob("real_*.csv")):
        frame: Any = pd.read_csv(path)
        frame = frame[frame.t >= 0.2]
        frame = frame.groupby((frame.t * RATE + 1e-6).astype(int))[["t", *POSE.values()]].mean()
        out.append(into / path.name)
        frame.to_csv(out[-1], index=False, float_format="%.7g")
    return out


def main() -> None:
    """Prepare and diagnose the real trials, and write the results."""
    import tempfile

    from experiments.real.robot_gap import RESULTS, summary
    from experiments.saving import save
    from simgap.robots.diagnose import diagnose
    from simgap.simulators.recording import read_recording
    from simgap.simulators.user import load_simulator

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--prepare", type=Path, metavar="DIR", help="write the prepared logs and stop")
    parser.add_argument("--output", type=Path, default=RESULTS / "collins_twojoint.json")
    given = parser.parse_args()
    if given.prepare is not None:
        given.prepare.mkdir(parents=True, exist_ok=True)
        prepare(given.folder, given.prepare)
        return
    simulator = load_simulator(f"{HERE / 'collins.py'}:TwoJoint")
    with tempfile.TemporaryDirectory() as into:
        logs = [read_recording(p, simulator.channels) for p in prepare(given.folder, Path(into))]
    save(given.output, summary(diagnose(simulator, logs, tell=print)))


if __name__ == "__main__":
    main()
