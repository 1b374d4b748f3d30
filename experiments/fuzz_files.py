"""Good files of every kind with what reads them, and ways to damage them."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hmmseg.io.task import BlockTask, SequenceTask


class Scene:
    """Good files of every kind, and what reads them."""

    def __init__(self, folder: Path) -> None:
        from hmmseg.io.rig import read_rig
        from hmmseg.io.task import parse_task, read_task

        self.folder = folder
        t = np.arange(24) / 20
        names = ("x1", "y1", "vx1", "vy1", "fx1", "fy1", "x2", "y2", "vx2", "vy2", "fx2", "fy2")
        rng = np.random.default_rng(0)
        table = {"t": t} | {name: 0.1 * rng.normal(size=24) + (name == "x2") for name in names}
        rows = [",".join(table), *(",".join(f"{table[name][i]:.6g}" for name in table) for i in range(24))]
        later = np.arange(80) / 20
        still = 0 * later
        arm = {"t": later, "px": later * 0.1, "pz": 0.1 + 0.02 * np.sin(3 * later), "fx": still, "fy": still,
               "gap": 0.05 - 0.03 * (np.abs(later - 2) < 1), "fz": 5 + 0.1 * rng.normal(size=80)}  # fmt: skip
        arm_rows = [",".join(arm), *(",".join(f"{arm[name][i]:.6g}" for name in arm) for i in range(80))]
        self.good: dict[str, bytes] = {
            "trial.csv": "\n".join(rows).encode(),
            "semicolons.csv": "\n".join(rows).replace(",", ";").replace(".", ",").encode(),
            "arm.csv": "\n".join(arm_rows).encode(),
            "rig.toml": RIG, "gripper.toml": GRIPPER, "task.toml": TASK, "sequence.toml": SEQUENCE,
            "actual.toml": ACTUAL,
        }  # fmt: skip
        self.good |= _binary(folder, table) | _lab()
        for name, data in self.good.items():
            (folder / name).write_bytes(data)
        self.rig, self.task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
        self.gripper = read_rig(folder / "gripper.toml")
        lab_task = read_task(folder / "lab-task.toml")
        assert isinstance(lab_task, BlockTask)
        self.lab_task = lab_task
        sequence = read_task(folder / "sequence.toml")
        assert isinstance(sequence, SequenceTask)
        self.sequence = sequence
        self.good["model.npz"] = _model(folder, self.sequence)
        self.order = parse_task({"sequence": ["reach", "lift"]})

    def read(self, name: str, path: Path) -> None:
        """Read a damaged file as its kind is read."""
        from estimation.report import read_actual
        from hmmseg.contact.decompose import decompose
        from hmmseg.hand.inspect import inspect
        from hmmseg.hand.read import read_trial
        from hmmseg.io.rig import read_rig
        from hmmseg.io.task import read_task
        from hmmseg.sequence.model import load_model
        from simgap.world.properties import read_properties

        if name == "arm.csv":
            read_trial(path, self.gripper)
        elif name == "lab.csv":
            read_trial(path, read_rig(self.folder / "lab-rig.toml"))
        elif name == "properties.json":
            read_properties(path, self.lab_task)
        elif name == "model.npz":
            load_model(path, self.sequence)
        elif name in ("rig.toml", "gripper.toml", "lab-rig.toml"):
            read_rig(path)
        elif name in ("task.toml", "sequence.toml", "lab-task.toml"):
            decompose(read_task(path))
        elif name == "actual.toml":
            read_actual(path, ("a", "b"))
        elif name == "info.json":
            (self.folder / "lerobot/meta/info.json").write_bytes(path.read_bytes())
            read_trial(self.folder / "lerobot", None, self.order)
        elif name in ("log.mcap", "log.bag", "demos.hdf5"):
            read_trial(path, None, self.order)
        else:
            inspect(path)
            read_trial(path, self.rig)


RIG = b"""rate = 20
gravity = 9.81
[fingertip]
normal_stiffness = 4000.0
shear_stiffness = inf
[noise]
position = 2e-5
force = 0.02
[systematic]
force_bias = [0.1, 0.1, 0.1, 0.1]
pad_stiffness = {1 = 0.1}
[tolerance]
force = 0.05
[columns]
x1 = {from = "x1", unit = "m", sign = 1, offset = 0.0}
"""
GRIPPER = b"""gravity = 9.81
[gripper]
position = {x = "px", z = "pz"}
closing = "x"
opening = "gap"
wrench = ["fx", "fy", "fz"]
frame = "sensor"
sensor_axes = ["y", "x", "-z"]
tool_mass = 0.5
grip_force = 10.0
"""
TASK = b"""repeat = 2
[objects.a]
on = "b"
[objects.b]
on = "ground"
[[moves]]
object = "a"
to = "ground"
[[moves]]
object = "a"
to = "b"
slide = false
"""
SEQUENCE = b"""sequence = ["approach", "insert", "mate"]
channels = ["fx1", "fy1"]
optional = ["insert"]
"""
ACTUAL = b"""[a]
weight = {value = 0.4, unit = "N", sd = 0.01}
width = {value = 0.02, unit = "m"}
[b]
height = {value = 0.02, unit = "m"}
"""


def _lab() -> dict[str, bytes]:
    """A recording that fits its task, what was identified from it, and a model of a plain ordered task."""
    from hmmseg.example import example_folder
    from hmmseg.io.schema import parse_toml

    folder = Path(example_folder())
    made = {f"lab-{name}": (folder / name).read_bytes() for name in ("rig.toml", "task.toml")}
    made["lab.csv"] = (folder / "trial_01.csv").read_bytes()
    names = parse_toml(made["lab-task.toml"].decode(), "task")["objects"]
    block = {"weight": 0.4, "width": 0.02, "height": 0.02}
    made["properties.json"] = json.dumps({
        "format": "hmmseg.identify/1",
        "properties": {name: {p: {"value": v, "sd": 0.01 * v} for p, v in block.items()} for name in names},
    }).encode()  # fmt: skip
    return made


def _model(folder: Path, task: SequenceTask) -> bytes:
    """A model of a plain ordered task, written to its place."""
    from hmmseg.hand.read import read_trial
    from hmmseg.sequence.fit import fit_sequence
    from hmmseg.sequence.model import save_model

    path = folder / "model.npz"
    save_model(fit_sequence([read_trial(folder / "trial.csv", None, task)], task), path)
    return path.read_bytes()


def _binary(folder: Path, table: dict[str, np.ndarray]) -> dict[str, bytes]:
    """The same table as NPZ, and as Parquet and HDF5 where their libraries are there."""
    made: dict[str, bytes] = {}
    buffer = io.BytesIO()
    np.savez(buffer, **table)  # type: ignore[arg-type]
    made["trial.npz"] = buffer.getvalue()
    with contextlib.suppress(ImportError):
        import pyarrow
        import pyarrow.parquet

        buffer = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.table(table), buffer)
        made["trial.parquet"] = buffer.getvalue()
    with contextlib.suppress(ImportError):  # of the tests; on the path where these run
        from file_writers import bag_of, mcap_of, planted, write_lerobot, write_robomimic

        made["demos.hdf5"] = write_robomimic(folder / "made-demos.hdf5").read_bytes()
        for name, write in (("log.mcap", mcap_of), ("log.bag", bag_of)):
            made[name] = write(folder / f"made-{name}", planted()).read_bytes()
        made["info.json"] = (write_lerobot(folder / "lerobot") / "meta/info.json").read_bytes()
    return made


# Damage: cut, lines shuffled or doubled, bytes flipped, cells beyond reason, unknown keys.
CELLS = ("nan", "inf", "-inf", "1e400", "-1e308", "1e-320", "", " ", "abc", "1,5", "0x10", "1_000", "1e",
         "--1", "٣", "9" * 5000, "\x00", '"', "'", "=1+1", "1970-01-01T00:00:00", "True", "null")  # fmt: skip
TOKENS = ("[", "]", "{", "}", "=", '"', "'''", "\n", "\x00", "\ufeff", "#", "inf", "nan", "1e999", "9" * 400,
          "[[a]]", "a.b.c = 1", "[" * 2000, "{a=" * 500, "-1", "true", '""', "2020-01-01",
          "\\u0000", "\ud7ff")  # fmt: skip
VALUES = ("-1", "0", "nan", "inf", "1e308", '"x"', "[]", "[1]", "{}", "true", "[" + "1," * 40 + "]",
          "1979-05-27", "9" * 300)  # fmt: skip
Damage = Callable[[bytes, np.random.Generator], bytes]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """Keep only the beginning of a file."""
    return data[: int(rng.integers(0, len(data) + 1))]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace some bytes."""
    out = np.frombuffer(data, np.uint8).copy()
    if out.size:
        at = rng.integers(0, out.size, int(rng.integers(1, 9)))
        out[at] = rng.integers(0, 256, at.size)
    return out.tobytes()


def shuffled(data: bytes, rng: np.random.Generator) -> bytes:
    """Shuffle the lines, sometimes keeping the first."""
    lines = data.split(b"\n")
    keep = int(rng.integers(0, 2))
    return b"\n".join([*lines[:keep], *(lines[keep:][i] for i in rng.permutation(len(lines) - keep))])


def doubled(data: bytes, rng: np.random.Generator) -> bytes:
    """Repeat a stretch."""
    a, b = sorted(int(i) for i in rng.integers(0, len(data) + 1, 2))
    return data[:b] + data[a:b] + data[b:]


def celled(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a few cells of a table."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        row = int(rng.integers(0, min(len(lines), 12)))
        cells = lines[row].split(b",")
        cells[int(rng.integers(0, len(cells)))] = str(rng.choice(CELLS)).encode("utf-8", "surrogatepass")
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def columned(data: bytes, rng: np.random.Generator) -> bytes:
    """A column removed, made constant, or doubled."""
    rows = [line.split(b",") for line in data.split(b"\n")]
    at, kind = int(rng.integers(0, len(rows[0]))), int(rng.integers(0, 3))
    for row in rows:
        if at < len(row):
            if kind == 0:
                del row[at]
            elif kind == 1:
                row[at] = rows[0][at] if row is rows[0] else b"3"
            else:
                row.append(row[at])
    return b"\n".join(b",".join(row) for row in rows)


def tokened(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert tokens of TOML and JSON anywhere."""
    text = data.decode("utf-8", "replace")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(text) + 1))
        text = text[:at] + str(rng.choice(TOKENS)) + text[at:]
    return text.encode("utf-8", "surrogatepass")


def valued(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace the value of a key."""
    lines = data.split(b"\n")
    keys = [i for i, line in enumerate(lines) if b"=" in line]
    if keys:
        i = int(rng.choice(keys))
        lines[i] = lines[i].split(b"=")[0] + b"= " + str(rng.choice(VALUES)).encode()
    return b"\n".join(lines)


TABLES: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, celled, celled, celled, columned)
TEXTS: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, tokened, tokened, valued, valued)
BINARIES: tuple[Damage, ...] = (cut, flipped, flipped, doubled)
