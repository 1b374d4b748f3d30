"""One planted recording in every kind of file, each written by the field's own library."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

START = 1_764_000_000_000_000_000  # ns since 1970
FAST = np.arange(200) * 10_000_000  # 100 Hz, of the wrenches
SLOW = np.arange(41) * 50_000_000 - 7_000_000  # 20 Hz, of the poses

HEADER = "std_msgs/Header header\n"
SEP = "=" * 80
STAMPED = f"{SEP}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" \
          f"{SEP}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"  # fmt: skip
WRENCH = f"{HEADER}geometry_msgs/Wrench wrench\n{SEP}\nMSG: geometry_msgs/Wrench\n" \
         f"geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n{SEP}\n" \
         f"MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n{STAMPED}"  # fmt: skip
JOINTS = f"{HEADER}string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{STAMPED}"
POSE = f"{HEADER}geometry_msgs/Pose pose\n{SEP}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\n" \
       f"geometry_msgs/Quaternion orientation\n{SEP}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\n" \
       f"float64 z\n{SEP}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n" \
       f"{STAMPED}"  # fmt: skip


def force(ns):
    """The planted wrench's x [N] at times since the start [ns]."""
    return 2 + np.sin(np.asarray(ns) * 1e-9)


def height(ns):
    """The planted pose's z [m]: linear, so that interpolation is exact."""
    return 0.1 + 0.02 * np.asarray(ns) * 1e-9


def joint(ns):
    """The planted second joint [rad]."""
    return -1.0 + 0.3 * np.asarray(ns) * 1e-9


def write_mcap(path: Path, gap: tuple[int, int] = (0, 0)) -> Path:
    """Wrench (100 Hz), joints and pose (20 Hz, without those between `gap`) and an opening without stamps."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        wrench = writer.register_msgdef("geometry_msgs/msg/WrenchStamped", WRENCH)
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        pose = writer.register_msgdef("geometry_msgs/msg/PoseStamped", POSE)
        number = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")

        upright = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}

        def put(topic, schema, ns, body, stamped=True):
            if stamped:
                body["header"] = {"stamp": _stamp(START + ns), "frame_id": "tool"}
            writer.write_message(topic, schema, body, log_time=START + ns + 300_000)  # logged a little later

        for ns in FAST.tolist():
            put(
                "/wrench",
                wrench,
                ns,
                {"wrench": {"force": _xyz(force(ns), 0.0, -1.0), "torque": _xyz(0.0, 0.0, 0.1)}},
            )
            put("/opening", number, ns, {"data": 0.06}, stamped=False)
        for ns in SLOW.tolist():
            if not gap[0] <= ns < gap[1]:
                put("/joints", joints, ns, {"name": ["a", "b"], "position": [0.5, float(joint(ns))],
                                            "velocity": [0.0, 0.3], "effort": []})  # fmt: skip
                put("/pose", pose, ns, {"pose": {"position": _xyz(0.0, 0.0, height(ns)),
                                                 "orientation": upright}})  # fmt: skip
        writer.finish()
    return path


def write_bag(path: Path) -> Path:
    """The same, in a ROS 1 bag (.bag) or a ROS 2 bag (a folder)."""
    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    t = store.types
    with Bag1(path) if one else Bag2(path, version=9) as writer:
        kinds = {"/wrench": "geometry_msgs/msg/WrenchStamped", "/joints": "sensor_msgs/msg/JointState",
                 "/pose": "geometry_msgs/msg/PoseStamped", "/opening": "std_msgs/msg/Float64"}  # fmt: skip
        links = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}

        def put(topic, ns, message):
            pack = store.serialize_ros1 if one else store.serialize_cdr
            writer.write(links[topic], START + ns + 300_000, pack(message, kinds[topic]))

        def header(ns):
            stamp = t["builtin_interfaces/msg/Time"](**_stamp(START + ns))
            more = {"seq": 0} if one else {}
            return t["std_msgs/msg/Header"](stamp=stamp, frame_id="tool", **more)

        vector, point = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Point"]
        for ns in FAST.tolist():
            body = t["geometry_msgs/msg/Wrench"](
                force=vector(x=float(force(ns)), y=0.0, z=-1.0), torque=vector(x=0.0, y=0.0, z=0.1)
            )
            put("/wrench", ns, t["geometry_msgs/msg/WrenchStamped"](header=header(ns), wrench=body))
            put("/opening", ns, t["std_msgs/msg/Float64"](data=0.06))
        for ns in SLOW.tolist():
            put("/joints", ns, t["sensor_msgs/msg/JointState"](
                header=header(ns), name=["a", "b"], position=np.array([0.5, float(joint(ns))]),
                velocity=np.array([0.0, 0.3]), effort=np.array([])))  # fmt: skip
            where = t["geometry_msgs/msg/Pose"](
                position=point(x=0.0, y=0.0, z=float(height(ns))),
                orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            )
            put("/pose", ns, t["geometry_msgs/msg/PoseStamped"](header=header(ns), pose=where))
    return path


def write_robomimic(path: Path, demos: int = 2) -> Path:
    """Demonstrations as robomimic lays them out, 20 Hz."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20}}
        )
        data.attrs["total"] = 50 * demos
        for k in range(demos):
            demo = data.create_group(f"demo_{k}")
            demo.attrs["num_samples"] = 50
            demo["actions"] = np.full((50, 7), k)
            demo["obs/robot0_eef_pos"] = np.stack(
                [np.arange(50.0) * 0.01, np.zeros(50), np.full(50, k)], axis=1
            )
            demo["obs/agentview_image"] = np.zeros((50, 8, 8, 3), dtype=np.uint8)
    return path


def write_lerobot(folder: Path, version: int = 3, episodes: int = 3) -> Path:
    """A data set as LeRobot lays it out: a file an episode (2), or all in one (3)."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    name = "episode_{episode_index:06d}" if version == 2 else "file-{file_index:03d}"
    info = {
        "codebase_version": "v2.1" if version == 2 else "v3.0", "fps": 50, "total_episodes": episodes,
        "total_frames": 60 * episodes, "chunks_size": 1000,
        "data_path": f"data/chunk-{{chunk_index:03d}}/{name}.parquet",
        "features": {
            "observation.state": {"dtype": "float32", "shape": [2], "names": ["left_x", "right_x"]},
            "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["a", "b"]}},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            "frame_index": {"dtype": "int64", "shape": [1], "names": None},
            "episode_index": {"dtype": "int64", "shape": [1], "names": None},
        },
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    tables = []
    for k in range(episodes):
        state = pa.FixedSizeListArray.from_arrays(pa.array(np.arange(120, dtype=np.float32) + k), 2)
        action = pa.array([[float(k), 1.0]] * 60, type=pa.list_(pa.float32()))
        tables.append(pa.table({
            "observation.state": state, "action": action,
            "timestamp": (np.arange(60) / 50).astype(np.float32), "frame_index": np.arange(60),
            "episode_index": np.full(60, k)}))  # fmt: skip
    if version == 2:
        (folder / "meta/episodes.jsonl").write_text(
            "".join(
                json.dumps({"episode_index": k, "tasks": ["stack"], "length": 60}) + "\n"
                for k in range(episodes)
            )
        )
        for k, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{k:06d}.parquet")
    else:
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    return folder


def _stamp(ns: int) -> dict[str, int]:
    return {"sec": ns // 1_000_000_000, "nanosec": ns % 1_000_000_000}


def _xyz(x, y, z) -> dict[str, float]:
    return {"x": float(x), "y": float(y), "z": float(z)}
