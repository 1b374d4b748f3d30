"""The way of somebody with another lab's files: inspect, write the mapping, read what was recorded."""

import numpy as np
import pytest
from fault_scene import CARTESIAN
from file_writers import lerobot_of, robomimic_of
from log_writers import bag_of, mcap_of
from walk_scene import finger_columns, finger_topics, finger_vectors, german, wrist_topics, wrist_vectors

from experiments.wrist_scene import Setup, performances, wrist_recording
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg_cli.main import main

FINGERS = {name: CARTESIAN[name] for name in ("t", "x1", "y1", "fx1", "fy1", "x2", "y2", "fx2", "fy2")}
RATE = 20
SIDES = {"1": "links", "2": "rechts"}
FINGER_NAMES = {
    name: (f"Finger_{SIDES[name[1]]}_{name[0]}_mm", 1e3) if len(name) == 2
    else (f"Kraft_{SIDES[name[2]]}_{name[1]}_N", 1.0)
    for name in FINGERS if name != "t"
}  # fmt: skip
WRIST_NAMES = {"width": ("Oeffnung_mm", 1e3), "ee_y": ("TCP_y_mm", 1e3), "ee_z": ("TCP_z_mm", 1e3),
               **{f"F{axis}": (f"F{axis}_N", 1.0) for axis in "xyz"}}  # fmt: skip


def lerobot(folder, version, rate, columns):
    states = np.stack(list(columns.values()), axis=1)
    lerobot_of(folder, version, rate, list(columns), [states, states], [np.zeros((len(states), 2))] * 2)
    return f"{folder}#1"


FINGER_FILES = {
    "MCAP": lambda f: mcap_of(f / "a.mcap", finger_topics(FINGERS)),
    "ROS 1 bag": lambda f: bag_of(f / "a.bag", finger_topics(FINGERS)),
    "ROS 2 bag": lambda f: bag_of(f / "a", finger_topics(FINGERS)),
    "LeRobot v2": lambda f: lerobot(f / "a", 2, RATE, finger_columns(FINGERS)),
    "LeRobot v3": lambda f: lerobot(f / "a", 3, RATE, finger_columns(FINGERS)),
    "robomimic": lambda f: f"{robomimic_of(f / 'a.hdf5', RATE, [finger_vectors(FINGERS)] * 2)}#demo_1",
    "CSV of a spreadsheet": lambda f: written(f / "a.csv", german(FINGERS, FINGER_NAMES)),
}


def written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", FINGER_FILES)
def test_two_fingers_read_as_recorded(tmp_path, kind):
    file, rig = FINGER_FILES[kind](tmp_path), tmp_path / "rig.toml"
    assert main(["inspect", str(file), "--write", str(rig), "--quiet"]) == 0
    trial = read_trial(file, read_rig(rig))
    assert trial.warnings == ()
    at = np.searchsorted(trial.t, FINGERS["t"] - FINGERS["t"][0] - 1e-4)  # poses are logged twice as often
    close = 1e-6 if "LeRobot" in kind else 2e-9  # single precision
    np.testing.assert_allclose(trial.t[at], FINGERS["t"] - FINGERS["t"][0], atol=1e-6)
    for name in FINGERS.keys() - {"t"}:
        np.testing.assert_allclose(trial.channels[name][at], FINGERS[name], atol=close, rtol=1e-6)


@pytest.fixture(scope="module")
def wrist():
    """A wrist's recording under the names of the arm that another simulator recorded."""
    setup = Setup(axes=("x", "y", "z"))
    columns = wrist_recording(performances(1)[0], setup)
    names = {"gap": "width", "py": "ee_y", "pz": "ee_z", "Fx": "Fx", "Fy": "Fy", "Fz": "Fz"}
    out = {"t": columns["t"]} | {theirs: columns[ours] for ours, theirs in names.items()}
    return out | {f"T{axis}": 0 * columns["t"] for axis in "xyz"}


WRIST_FILES = {
    "MCAP": lambda f, c: mcap_of(f / "a.mcap", wrist_topics(c)),
    "ROS 1 bag": lambda f, c: bag_of(f / "a.bag", wrist_topics(c)),
    "ROS 2 bag": lambda f, c: bag_of(f / "a", wrist_topics(c)),
    "LeRobot v3": lambda f, c: lerobot(f / "a", 3, 50, {k: v for k, v in c.items() if k != "t"}),
    "CSV of a spreadsheet": lambda f, c: written(f / "a.csv", german(c, WRIST_NAMES)),
    "robomimic": lambda f, c: f"{robomimic_of(f / 'a.hdf5', 50, [wrist_vectors(c)])}#demo_0",
}


@pytest.mark.parametrize("kind", WRIST_FILES)
def test_a_wrist_reads_as_recorded(tmp_path, wrist, kind, capsys):
    plain = parse_rig({"gripper": {"position": {"y": "ee_y", "z": "ee_z"}, "opening": "width",
                                   "wrench": ["Fx", "Fy", "Fz"]}})  # fmt: skip
    expected = read_trial(wrist, plain)
    file, rig = WRIST_FILES[kind](tmp_path, wrist), tmp_path / "rig.toml"
    assert main(["inspect", str(file), "--write", str(rig), "--quiet"]) == 0
    if kind == "robomimic":  # its second finger counts the other way, and the line says so
        task = written(
            tmp_path / "task.toml", b'[objects.a]\non = "ground"\n[[moves]]\nobject = "a"\nto = "ground"\n'
        )
        assert main(["segment", str(file), "--task", str(task), "--rig", str(rig)]) == 2
        line = capsys.readouterr().err
        entry = line.split("expected ")[1].split(" under [columns]")[0]
        rig.write_text(f"{rig.read_text()}\n[columns]\n{entry}\n")
    trial = read_trial(file, read_rig(rig))
    assert trial.warnings == ()
    for name in ("x1", "y1", "fy1", "x2", "y2", "fy2"):
        np.testing.assert_allclose(
            trial.channels[name], expected.channels[name], atol=1e-3 * (name[0] == "f") + 2e-5
        )
