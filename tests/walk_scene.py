"""One recording as other labs would have it: topics of ROS, LeRobot, robomimic, a spreadsheet's CSV."""

import numpy as np
from log_writers import Topic

START = 1_764_000_000_123_456_789  # ns since 1970
WRENCH, POSE = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped"


def finger_topics(c: dict[str, np.ndarray]) -> list[Topic]:
    """Two fingertips that close along y and lift along z: poses twice as often as wrenches.

    `c`: columns t, x1, y1, fx1, fy1, x2, y2, fx2, fy2 (num_timesteps,).
    """
    t, twice = c["t"], np.sort(np.r_[c["t"], (c["t"][1:] + c["t"][:-1]) / 2])
    out = []
    for side, i in (("left", 1), ("right", 2)):
        push = np.stack([0 * t, c[f"fx{i}"], c[f"fy{i}"]], axis=1)
        x, y = (np.interp(twice, t, c[f"{axis}{i}"]) for axis in "xy")
        place = np.stack([0 * x + 0.4, x, y], axis=1)
        out.append(Topic(f"/{side}_finger/wrench", WRENCH, stamps(t), {"force": push}))
        out.append(Topic(f"/{side}_finger/tip_pose", POSE, stamps(twice), {"position": place}))
    return out


def wrist_topics(c: dict[str, np.ndarray], joints: int = 1) -> list[Topic]:
    """An arm's pose and wrench on the recording's clock, a gripper's fingers at every `joints`-th time of it.

    `c`: columns t, width, ee_y, ee_z, Fx to Tz (num_timesteps,).
    """
    t, half = c["t"], c["width"][::joints] / 2
    fingers = {"panda_finger_joint1": half, "panda_finger_joint2": half}
    still = {name: 0 * half for name in fingers}
    wrench = {name: np.stack([c[f"{letter}{axis}"] for axis in "xyz"], axis=1)
              for name, letter in (("force", "F"), ("torque", "T"))}  # fmt: skip
    place = np.stack([0 * t + 0.5, c["ee_y"], c["ee_z"]], axis=1)
    return [
        Topic("/franka/ee_pose", POSE, stamps(t), {"position": place}),
        Topic("/ft_sensor/wrench", WRENCH, stamps(t), wrench),
        Topic("/franka_gripper/joint_states", "sensor_msgs/msg/JointState", stamps(t[::joints]),
              {"position": fingers, "velocity": still}),
    ]  # fmt: skip


def stamps(t: np.ndarray) -> np.ndarray:
    """Times [s] (num_timesteps,) as ns since 1970."""
    return START + np.round(t * 1e9).astype(np.int64)


def finger_columns(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same two fingertips as columns of a data set's state."""
    out = {}
    for side, i in (("left", 1), ("right", 2)):
        out |= {f"{side}_tip_x": c[f"x{i}"], f"{side}_tip_z": c[f"y{i}"]}
        out |= {f"{side}_force_x": c[f"fx{i}"], f"{side}_force_z": c[f"fy{i}"]}
    return out


def finger_vectors(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same as vectors (num_timesteps, 3) of observations that close along y."""
    still = 0 * c["t"]
    return {
        f"obs/{side}_fingertip_{name}": np.stack([still, c[f"{letter}x{i}"], c[f"{letter}y{i}"]], axis=1)
        for side, i in (("left", 1), ("right", 2))
        for name, letter in (("pos", ""), ("force", "f"))
    }


def wrist_vectors(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A wrist as robosuite's observations: finger joints that count opposite ways."""
    still, half = 0 * c["t"], c["width"] / 2
    return {
        "obs/robot0_eef_pos": np.stack([still + 0.5, c["ee_y"], c["ee_z"]], axis=1),
        "obs/robot0_gripper_qpos": np.stack([half, -half], axis=1),
        "obs/robot0_ee_force": np.stack([c["Fx"], c["Fy"], c["Fz"]], axis=1),
        "obs/robot0_ee_torque": np.stack([c["Tx"], c["Ty"], c["Tz"]], axis=1),
    }


def german(columns: dict[str, np.ndarray], names: dict[str, tuple[str, float]]) -> bytes:
    """A spreadsheet's CSV: semicolons, decimal commas, remarks with umlauts, ISO stamps.

    `names`: theirs and how many of their units are one of ours, by column.
    """
    start = np.datetime64("2026-03-02T10:15:30.250000")
    rows = ["# Prüfstand 3, Messung vom 2.3.2026", "% Greifer mit Schaumbelägen"]
    rows.append(";".join(["Zeitstempel", *(theirs for theirs, _ in names.values())]))
    for k, t in enumerate(columns["t"]):
        stamp = start + np.timedelta64(round(float(t) * 1e6), "us")
        cells = [f"{columns[name][k] * size:.9f}".replace(".", ",") for name, (_, size) in names.items()]
        rows.append(";".join([str(stamp), *cells]))
    return "\n".join(rows).encode("cp1252")
