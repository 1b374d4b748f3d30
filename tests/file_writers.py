"""Recordings in every kind of file, each written by its own library, and as other labs would have them."""

import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

DELAY = 300_000  # ns: a message is logged a little later than its stamp
WRENCH, POSE = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped"
START = 1_764_000_000_000_000_000  # ns since 1970
FAST = np.arange(200) * 10_000_000  # 100 Hz, of the wrenches
SLOW = np.arange(41) * 50_000_000 - 7_000_000  # 20 Hz, of the poses
ODD_START = 1_764_000_000_123_456_789  # ns since 1970


@dataclass(frozen=True)
class Topic:
    """Messages of a kind at times [ns since 1970] (num_messages,); `values` by field, what is absent zero."""

    name: str
    kind: str
    ns: np.ndarray
    values: dict
    stamps: np.ndarray | None = None  # of its headers, where they are of another clock

    def message(self, types: dict, k: int):
        """Message k in the types of a ROS distribution."""
        ns, v = int((self.ns if self.stamps is None else self.stamps)[k]), self.values
        if self.kind == "std_msgs/msg/Float64":
            return types[self.kind](data=float(v["data"][k]))
        geometry = {n.split("/")[-1]: made for n, made in types.items() if n.startswith("geometry_msgs/")}
        header = types["std_msgs/msg/Header"]
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        one = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
        head = header(stamp=stamp, frame_id="tool", **one)
        if self.kind == WRENCH:
            three = {n: v[n][k] if n in v else np.zeros(3) for n in ("force", "torque")}
            parts = {n: geometry["Vector3"](*map(float, each)) for n, each in three.items()}
            return types[self.kind](header=head, wrench=geometry["Wrench"](**parts))
        if self.kind == POSE:
            place, straight = geometry["Point"](*map(float, v["position"][k])), (0.0, 0.0, 0.0, 1.0)
            pose = geometry["Pose"](position=place, orientation=geometry["Quaternion"](*straight))
            return types[self.kind](header=head, pose=pose)
        joints = {n: np.array([c[k] for c in v[n].values()], float) for n in ("position", "velocity")}
        return types[self.kind](header=head, name=list(v["position"]), effort=np.zeros(0), **joints)


def mcap_of(path: Path, topics: list[Topic]) -> Path:
    """A log of these topics, messages in order of time."""
    store, channels = get_typestore(Stores.ROS2_HUMBLE), {}
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        for name, kind in {t.name: t.kind for t in topics}.items():
            text, _ = store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[name] = writer.register_channel(name, "cdr", schema)
        for topic, k in _ordered(topics):
            ns, message = int(topic.ns[k]) + DELAY, topic.message(store.types, k)
            data = bytes(store.serialize_cdr(message, topic.kind))
            writer.add_message(channels[topic.name], ns, data, ns)
        writer.finish()
    return path


def bag_of(path: Path, topics: list[Topic]) -> Path:
    """A ROS 1 bag (.bag) or a ROS 2 bag (a folder) of these topics."""
    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    pack = store.serialize_ros1 if one else store.serialize_cdr
    with Bag1(path) if one else Bag2(path, version=9) as writer:
        links = {t.name: writer.add_connection(t.name, t.kind, typestore=store) for t in topics}
        for topic, k in _ordered(topics):
            message = pack(topic.message(store.types, k), topic.kind)
            writer.write(links[topic.name], int(topic.ns[k]) + DELAY, message)
    return path


def _ordered(topics: list[Topic]) -> list[tuple[Topic, int]]:
    every = [(int(ns), number, k) for number, t in enumerate(topics) for k, ns in enumerate(t.ns)]
    return [(topics[number], k) for _, number, k in sorted(every)]


def force(ns):
    return 2 + np.sin(np.asarray(ns) * 1e-9)


def height(ns):
    """The planted pose's z [m]: linear, so that interpolation is exact."""
    return 0.1 + 0.02 * np.asarray(ns) * 1e-9


def joint(ns):
    return -1.0 + 0.3 * np.asarray(ns) * 1e-9


def planted(gap: tuple[int, int] = (0, 0)) -> list[Topic]:
    """Wrench (100 Hz), joints and pose (20 Hz, without those between `gap`) and an opening without stamps."""
    push = np.stack([force(FAST), 0.0 * FAST, 0.0 * FAST - 1.0], axis=1)
    slow = SLOW[(gap[0] > SLOW) | (gap[1] <= SLOW)]
    still = 0.0 * slow
    joints = {"position": {"a": still + 0.5, "b": joint(slow)}, "velocity": {"a": still, "b": still + 0.3}}
    place = np.stack([still, still, height(slow)], axis=1)
    return [Topic("/wrench", WRENCH, START + FAST,
                  {"force": push, "torque": np.tile([0.0, 0.0, 0.1], (FAST.size, 1))}),
            Topic("/opening", "std_msgs/msg/Float64", START + FAST, {"data": np.full(FAST.size, 0.06)}),
            Topic("/joints", "sensor_msgs/msg/JointState", START + slow, joints),
            Topic("/pose", POSE, START + slow, {"position": place})]  # fmt: skip


def write_robomimic(path: Path, demos: int = 2) -> Path:
    """Demonstrations as robomimic lays them out, 20 Hz, images among them."""
    steps = np.arange(50.0)
    place = [np.stack([steps * 0.01, 0 * steps, 0 * steps + k], axis=1) for k in range(demos)]
    return robomimic_of(path, 20, [{"actions": np.full((50, 7), k), "obs/robot0_eef_pos": place[k],
                                    "obs/agentview_image": np.zeros((50, 8, 8, 3), dtype=np.uint8)}
                                   for k in range(demos)])  # fmt: skip


def robomimic_of(path: Path, rate: int, demos: list[dict[str, np.ndarray]]) -> Path:
    """Demonstrations of these data sets by their place below the demonstration."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1,
                                             "env_kwargs": {"control_freq": rate}})  # fmt: skip
        data.attrs["total"] = sum(len(next(iter(demo.values()))) for demo in demos)
        for k, columns in enumerate(demos):
            demo = data.create_group(f"demo_{k}")
            demo.attrs["num_samples"] = len(next(iter(columns.values())))
            for name, values in columns.items():
                demo[name] = values
    return path


def write_lerobot(folder: Path, version: int = 3, episodes: int = 3) -> Path:
    """A data set of 60 samples an episode at 50 Hz."""
    states = [np.arange(120, dtype=np.float32).reshape(60, 2) + k for k in range(episodes)]
    actions = [np.tile([float(k), 1.0], (60, 1)) for k in range(episodes)]
    return lerobot_of(folder, version, 50, ["left_x", "right_x"], states, actions)


def lerobot_of(folder: Path, version: int, fps: int, names: list[str], states: list[np.ndarray],
               actions: list[np.ndarray]) -> Path:  # fmt: skip
    """A data set as LeRobot has it, a file an episode (2) or all in one (3)."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    name = "episode_{episode_index:06d}" if version == 2 else "file-{file_index:03d}"
    lengths = [len(state) for state in states]
    info = {"codebase_version": "v2.1" if version == 2 else "v3.0", "fps": fps, "total_episodes": len(states),
            "total_frames": sum(lengths), "chunks_size": 1000,
            "data_path": f"data/chunk-{{chunk_index:03d}}/{name}.parquet",
            "features": {"observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
                         "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["a", "b"]}},
                         "timestamp": {"dtype": "float32", "shape": [1], "names": None},
                         "frame_index": {"dtype": "int64", "shape": [1], "names": None},
                         "episode_index": {"dtype": "int64", "shape": [1], "names": None}}}  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    tables = []
    for k, (state, action, n) in enumerate(zip(states, actions, lengths, strict=True)):
        wide = pa.array(state.astype(np.float32).ravel())
        tables.append(pa.table({
            "observation.state": pa.FixedSizeListArray.from_arrays(wide, len(names)),
            "action": pa.array(action.tolist(), type=pa.list_(pa.float32())),
            "timestamp": (np.arange(n) / fps).astype(np.float32), "frame_index": np.arange(n),
            "episode_index": np.full(n, k)}))  # fmt: skip
    if version == 2:
        said = [{"episode_index": k, "tasks": ["stack"], "length": n} for k, n in enumerate(lengths)]
        (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(each) + "\n" for each in said))
        for k, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{k:06d}.parquet")
    else:
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    return folder


def finger_topics(c: dict[str, np.ndarray]) -> list[Topic]:
    """Two fingertips that close along y and lift along z: poses twice as often as wrenches."""
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
    """An arm's pose and wrench on the recording's clock, fingers at every `joints`-th time of it."""
    t, half = c["t"], c["width"][::joints] / 2
    fingers = {"panda_finger_joint1": half, "panda_finger_joint2": half}
    still = {name: 0 * half for name in fingers}
    wrench = {name: np.stack([c[f"{letter}{axis}"] for axis in "xyz"], axis=1)
              for name, letter in (("force", "F"), ("torque", "T"))}  # fmt: skip
    place = np.stack([0 * t + 0.5, c["ee_y"], c["ee_z"]], axis=1)
    return [Topic("/franka/ee_pose", POSE, stamps(t), {"position": place}),
            Topic("/ft_sensor/wrench", WRENCH, stamps(t), wrench),
            Topic("/franka_gripper/joint_states", "sensor_msgs/msg/JointState", stamps(t[::joints]),
                  {"position": fingers, "velocity": still})]  # fmt: skip


def stamps(t: np.ndarray) -> np.ndarray:
    return ODD_START + np.round(t * 1e9).astype(np.int64)


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
    return {f"obs/{side}_fingertip_{name}": np.stack([still, c[f"{letter}x{i}"], c[f"{letter}y{i}"]], axis=1)
            for side, i in (("left", 1), ("right", 2))
            for name, letter in (("pos", ""), ("force", "f"))}  # fmt: skip


def wrist_vectors(c: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A wrist as robosuite's observations: finger joints that count opposite ways."""
    still, half = 0 * c["t"], c["width"] / 2
    return {"obs/robot0_eef_pos": np.stack([still + 0.5, c["ee_y"], c["ee_z"]], axis=1),
            "obs/robot0_gripper_qpos": np.stack([half, -half], axis=1),
            "obs/robot0_ee_force": np.stack([c["Fx"], c["Fy"], c["Fz"]], axis=1),
            "obs/robot0_ee_torque": np.stack([c["Tx"], c["Ty"], c["Tz"]], axis=1)}  # fmt: skip


def german(columns: dict[str, np.ndarray], names: dict[str, tuple[str, float]]) -> bytes:
    """A spreadsheet's CSV; `names`: theirs and how many of their units are one of ours, by column."""
    start = np.datetime64("2026-03-02T10:15:30.250000")
    rows = ["# Prüfstand 3, Messung vom 2.3.2026", "% Greifer mit Schaumbelägen"]
    rows.append(";".join(["Zeitstempel", *(theirs for theirs, _ in names.values())]))
    for k, t in enumerate(columns["t"]):
        stamp = start + np.timedelta64(round(float(t) * 1e6), "us")
        cells = [f"{columns[name][k] * size:.9f}".replace(".", ",") for name, (_, size) in names.items()]
        rows.append(";".join([str(stamp), *cells]))
    return "\n".join(rows).encode("cp1252")
