"""One planted recording in every kind of file, each written by the field's own library."""

import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from log_writers import Topic, bag_of, mcap_of

START = 1_764_000_000_000_000_000  # ns since 1970
FAST = np.arange(200) * 10_000_000  # 100 Hz, of the wrenches
SLOW = np.arange(41) * 50_000_000 - 7_000_000  # 20 Hz, of the poses


def force(ns):
    """The planted wrench's x [N] at times since the start [ns]."""
    return 2 + np.sin(np.asarray(ns) * 1e-9)


def height(ns):
    """The planted pose's z [m]: linear, so that interpolation is exact."""
    return 0.1 + 0.02 * np.asarray(ns) * 1e-9


def joint(ns):
    """The planted second joint [rad]."""
    return -1.0 + 0.3 * np.asarray(ns) * 1e-9


def planted(gap: tuple[int, int] = (0, 0)) -> list[Topic]:
    """Wrench (100 Hz), joints and pose (20 Hz, without those between `gap`) and an opening without stamps."""
    push = np.stack([force(FAST), 0.0 * FAST, 0.0 * FAST - 1.0], axis=1)
    slow = SLOW[(gap[0] > SLOW) | (gap[1] <= SLOW)]
    still = 0.0 * slow
    joints = {"position": {"a": still + 0.5, "b": joint(slow)}, "velocity": {"a": still, "b": still + 0.3}}
    place = np.stack([still, still, height(slow)], axis=1)
    return [
        Topic("/wrench", "geometry_msgs/msg/WrenchStamped", START + FAST,
              {"force": push, "torque": np.tile([0.0, 0.0, 0.1], (FAST.size, 1))}),
        Topic("/opening", "std_msgs/msg/Float64", START + FAST, {"data": np.full(FAST.size, 0.06)}),
        Topic("/joints", "sensor_msgs/msg/JointState", START + slow, joints),
        Topic("/pose", "geometry_msgs/msg/PoseStamped", START + slow, {"position": place}),
    ]  # fmt: skip


def write_mcap(path: Path, gap: tuple[int, int] = (0, 0)) -> Path:
    """The planted topics in an MCAP log."""
    return mcap_of(path, planted(gap))


def write_bag(path: Path) -> Path:
    """The same, in a ROS 1 bag (.bag) or a ROS 2 bag (a folder)."""
    return bag_of(path, planted())


def write_robomimic(path: Path, demos: int = 2) -> Path:
    """Demonstrations as robomimic lays them out, 20 Hz, images among them."""
    steps = np.arange(50.0)
    place = [np.stack([steps * 0.01, 0 * steps, 0 * steps + k], axis=1) for k in range(demos)]
    return robomimic_of(path, 20, [
        {"actions": np.full((50, 7), k), "obs/robot0_eef_pos": place[k],
         "obs/agentview_image": np.zeros((50, 8, 8, 3), dtype=np.uint8)}
        for k in range(demos)
    ])  # fmt: skip


def robomimic_of(path: Path, rate: int, demos: list[dict[str, np.ndarray]]) -> Path:
    """Demonstrations of these data sets by their place below the demonstration."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": rate}}
        )
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
    """A data set as LeRobot lays it out: a file an episode (2), or all in one (3).

    `states` of each episode (num_timesteps, num_names), `actions` (num_timesteps, 2).
    """
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    name = "episode_{episode_index:06d}" if version == 2 else "file-{file_index:03d}"
    lengths = [len(state) for state in states]
    info = {
        "codebase_version": "v2.1" if version == 2 else "v3.0", "fps": fps, "total_episodes": len(states),
        "total_frames": sum(lengths), "chunks_size": 1000,
        "data_path": f"data/chunk-{{chunk_index:03d}}/{name}.parquet",
        "features": {
            "observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
            "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["a", "b"]}},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            "frame_index": {"dtype": "int64", "shape": [1], "names": None},
            "episode_index": {"dtype": "int64", "shape": [1], "names": None},
        },
    }  # fmt: skip
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
        (folder / "meta/episodes.jsonl").write_text(
            "".join(
                json.dumps({"episode_index": k, "tasks": ["stack"], "length": n}) + "\n"
                for k, n in enumerate(lengths)
            )
        )
        for k, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{k:06d}.parquet")
    else:
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    return folder
