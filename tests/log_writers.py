"""Messages of ROS in MCAP logs and bags, each written by the field's own library."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

DELAY = 300_000  # ns: a message is logged a little later than its stamp
HEADER = "std_msgs/Header header\n"
SEP = "=" * 80
STAMPED = f"{SEP}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" \
          f"{SEP}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"  # fmt: skip
VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
SCHEMAS = {
    "geometry_msgs/msg/WrenchStamped": f"{HEADER}geometry_msgs/Wrench wrench\n{SEP}\n"
    "MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
    f"{SEP}\nMSG: geometry_msgs/Vector3\n{VECTOR}{STAMPED}",
    "sensor_msgs/msg/JointState": f"{HEADER}string[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{STAMPED}",
    "geometry_msgs/msg/PoseStamped": f"{HEADER}geometry_msgs/Pose pose\n{SEP}\nMSG: geometry_msgs/Pose\n"
    "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{SEP}\nMSG: geometry_msgs/Point\n{VECTOR}{SEP}\nMSG: geometry_msgs/Quaternion\n{VECTOR}float64 w\n"
    f"{STAMPED}",
    "std_msgs/msg/Float64": "float64 data",
}  # fmt: skip


@dataclass(frozen=True)
class Topic:
    """Messages of one kind at times [ns since 1970] (num_messages,).

    `values` by field: of a wrench and a pose `force`, `torque`, `position` (num_messages, 3) and
    `orientation` (num_messages, 4), what is absent zero (no turn); of a JointState columns by the joints'
    names in `position` and `velocity`; of a Float64 `data` (num_messages,), which has no stamp.
    """

    name: str
    kind: str
    ns: np.ndarray
    values: dict
    stamps: np.ndarray | None = None  # of its headers, where they are of another clock

    def body(self, k: int) -> dict:
        """Message k as plain Python, without its header."""
        v = {name: each if isinstance(each, dict) else each[k] for name, each in self.values.items()}
        if self.kind == "std_msgs/msg/Float64":
            return {"data": float(v["data"])}
        if self.kind == "geometry_msgs/msg/WrenchStamped":
            return {
                "wrench": {name: _axes(v.get(name, (0.0, 0.0, 0.0)), "xyz") for name in ("force", "torque")}
            }
        if self.kind == "geometry_msgs/msg/PoseStamped":
            turn = _axes(v.get("orientation", (0.0, 0.0, 0.0, 1.0)), "xyzw")
            return {"pose": {"position": _axes(v["position"], "xyz"), "orientation": turn}}
        arrays = {name: [float(c[k]) for c in v.get(name, {}).values()] for name in ("position", "velocity")}
        return {"name": list(v["position"]), **arrays, "effort": []}

    @property
    def stamped(self) -> bool:
        """Whether the kind has a header."""
        return self.kind != "std_msgs/msg/Float64"


def mcap_of(path: Path, topics: list[Topic]) -> Path:
    """A log of these topics, messages in order of time."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        schemas = {kind: writer.register_msgdef(kind, SCHEMAS[kind]) for kind in {t.kind for t in topics}}
        for topic, k in _ordered(topics):
            ns = int(topic.ns[k])
            stamp = ns if topic.stamps is None else int(topic.stamps[k])
            head = {"header": {"stamp": _stamp(stamp), "frame_id": "tool"}} if topic.stamped else {}
            body = topic.body(k) | head
            writer.write_message(topic.name, schemas[topic.kind], body, log_time=ns + DELAY)
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
            ns = int(topic.ns[k])
            body = {name: _typed(store.types, each) for name, each in topic.body(k).items()}
            if topic.stamped:
                stamp = store.types["builtin_interfaces/msg/Time"](**_stamp(ns))
                more = {"seq": 0} if one else {}
                body["header"] = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="tool", **more)
            writer.write(links[topic.name], ns + DELAY, pack(store.types[topic.kind](**body), topic.kind))
    return path


def _typed(types, value):
    """A part of a message in the library's own types."""
    if isinstance(value, list) and not (value and isinstance(value[0], str)):
        return np.array(value, dtype=np.float64)
    if not isinstance(value, dict):
        return value
    inner = {name: _typed(types, each) for name, each in value.items()}
    if "force" in inner:
        return types["geometry_msgs/msg/Wrench"](**inner)
    if "position" in inner:
        point = types["geometry_msgs/msg/Point"](**value["position"])
        return types["geometry_msgs/msg/Pose"](position=point, orientation=inner["orientation"])
    return types[f"geometry_msgs/msg/{'Quaternion' if 'w' in inner else 'Vector3'}"](**inner)


def _ordered(topics: list[Topic]) -> list[tuple[Topic, int]]:
    every = [(int(ns), number, k) for number, t in enumerate(topics) for k, ns in enumerate(t.ns)]
    return [(topics[number], k) for _, number, k in sorted(every)]


def _axes(values, names: str) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _stamp(ns: int) -> dict[str, int]:
    return {"sec": ns // 1_000_000_000, "nanosec": ns % 1_000_000_000}
