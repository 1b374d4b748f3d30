"""Hostile input to every reader and command, in process: one line of InputError, or a result; nothing else.

    python -m experiments.fuzz [--cases 100000] [--seed 0] [--keep FOLDER]

A case takes a good file, damages it (cut, lines shuffled or doubled, bytes flipped, cells that are no
numbers or beyond all reason, deep nesting, keys unknown or of another type), and reads it as users would.
Commands run in a folder of their own, which must hold nothing new after exit 2. A case that fails is kept,
with how to repeat it. With tests/ on the path logs and data sets are damaged as well.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import json
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hmmseg.errors import InputError

CELLS = ("nan", "inf", "-inf", "1e400", "-1e308", "1e-320", "", " ", "abc", "1,5", "0x10", "1_000", "1e",
         "--1", "٣", "9" * 5000, "\x00", '"', "'", "=1+1", "1970-01-01T00:00:00", "True", "null")  # fmt: skip
TOKENS = ("[", "]", "{", "}", "=", '"', "'''", "\n", "\x00", "\ufeff", "#", "inf", "nan", "1e999", "9" * 400,
          "[[a]]", "a.b.c = 1", "[" * 2000, "{a=" * 500, "-1", "true", '""', "2020-01-01",
          "\\u0000", "\ud7ff")  # fmt: skip

VALUES = ("-1", "0", "nan", "inf", "1e308", '"x"', "[]", "[1]", "{}", "true", "[" + "1," * 40 + "]",
          "1979-05-27", "9" * 300)  # fmt: skip

Damage = Callable[[bytes, np.random.Generator], bytes]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of a file."""
    return data[: int(rng.integers(0, len(data) + 1))]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes replaced."""
    out = np.frombuffer(data, np.uint8).copy()
    if out.size:
        at = rng.integers(0, out.size, int(rng.integers(1, 9)))
        out[at] = rng.integers(0, 256, at.size)
    return out.tobytes()


def shuffled(data: bytes, rng: np.random.Generator) -> bytes:
    """Lines in another order, the first sometimes left."""
    lines = data.split(b"\n")
    keep = int(rng.integers(0, 2))
    return b"\n".join([*lines[:keep], *(lines[keep:][i] for i in rng.permutation(len(lines) - keep))])


def doubled(data: bytes, rng: np.random.Generator) -> bytes:
    """A stretch twice."""
    a, b = sorted(int(i) for i in rng.integers(0, len(data) + 1, 2))
    return data[:b] + data[a:b] + data[b:]


def celled(data: bytes, rng: np.random.Generator) -> bytes:
    """A few cells of a table replaced."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        row = int(rng.integers(0, min(len(lines), 12)))
        cells = lines[row].split(b",")
        cells[int(rng.integers(0, len(cells)))] = str(rng.choice(CELLS)).encode("utf-8", "surrogatepass")
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def columned(data: bytes, rng: np.random.Generator) -> bytes:
    """A column gone, all alike, or twice."""
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
    """Tokens of TOML and JSON put in anywhere."""
    text = data.decode("utf-8", "replace")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(text) + 1))
        text = text[:at] + str(rng.choice(TOKENS)) + text[at:]
    return text.encode("utf-8", "surrogatepass")


def valued(data: bytes, rng: np.random.Generator) -> bytes:
    """The value of a key replaced."""
    lines = data.split(b"\n")
    keys = [i for i, line in enumerate(lines) if b"=" in line]
    if keys:
        i = int(rng.choice(keys))
        values = (
            "-1",
            "0",
            "nan",
            "inf",
            "1e308",
            '"x"',
            "[]",
            "[1]",
            "{}",
            "true",
            "[" + "1," * 40 + "]",
            "1979-05-27",
            "9" * 300,
        )
        lines[i] = lines[i].split(b"=")[0] + b"= " + str(rng.choice(values)).encode()
    return b"\n".join(lines)


TABLES: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, celled, celled, celled, columned)
TEXTS: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, tokened, tokened, valued, valued)
BINARIES: tuple[Damage, ...] = (cut, flipped, flipped, doubled)


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
        self.good |= _binary(folder, table)
        for name, data in self.good.items():
            (folder / name).write_bytes(data)
        self.rig, self.task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
        self.gripper = read_rig(folder / "gripper.toml")
        self.order = parse_task({"sequence": ["reach", "lift"]})

    def read(self, name: str, path: Path) -> None:
        """Read a damaged file as its kind is read."""
        from estimation.actual import read_actual
        from hmmseg.contact.decompose import decompose
        from hmmseg.io.inspect import inspect
        from hmmseg.io.rig import read_rig
        from hmmseg.io.task import read_task
        from hmmseg.io.trial import read_trial

        if name == "arm.csv":
            read_trial(path, self.gripper)
        elif name in ("rig.toml", "gripper.toml"):
            read_rig(path)
        elif name in ("task.toml", "sequence.toml"):
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
channels = ["fx", "fy"]
optional = ["insert"]
"""
ACTUAL = b"""[a]
weight = {value = 0.4, unit = "N", sd = 0.01}
width = {value = 0.02, unit = "m"}
[b]
height = {value = 0.02, unit = "m"}
"""


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
        from file_writers import write_bag, write_lerobot, write_mcap, write_robomimic

        for name, write in (
            ("log.mcap", write_mcap),
            ("log.bag", write_bag),
            ("demos.hdf5", write_robomimic),
        ):
            made[name] = write(folder / f"made-{name}").read_bytes()
        made["info.json"] = (write_lerobot(folder / "lerobot") / "meta/info.json").read_bytes()
    return made


HAND = ("--task", "task.toml", "--rig", "rig.toml")
COMMANDS: dict[str, list[list[str]]] = {
    "task.toml": [["decompose", "@"], ["segment", "trial.csv", "--task", "@", "--rig", "rig.toml"]],
    "sequence.toml": [["decompose", "@"], ["fit", "trial.csv", "--task", "@", "--model", "m.npz"]],
    "rig.toml": [["segment", "trial.csv", "--task", "task.toml", "--rig", "@", "--method", "qualitative"],
                 ["inspect", "trial.csv", "--rig", "@"], ["decompose", "task.toml", "--rig", "@"]],
    "gripper.toml": [["segment", "arm.csv", "--task", "task.toml", "--rig", "@"]],
    "trial.csv": [["inspect", "@"], ["segment", "@", *HAND, "--method", "qualitative"],
                  ["identify", "@", *HAND, "--method", "paper"]],
    "semicolons.csv": [["inspect", "@", "--write", "new.toml"]],
    "actual.toml": [["identify", "trial.csv", *HAND, "--method", "paper", "--actual", "@"]],
}  # fmt: skip


def one_case(scene: Scene, name: str, data: bytes, command: list[str] | None) -> str:
    """ "read", "refused" or "exit N"; AssertionError or any other exception where the case fails."""
    path = scene.folder / f"case-{name}"
    path.write_bytes(data)
    try:
        if command is None:
            try:
                scene.read(name, path)
            except InputError as error:
                assert "\n" not in str(error) and len(str(error)) < 20_000, (
                    f"not one line: {str(error)[:200]}"
                )
                return "refused"
            return "read"
        return _command(scene, path, command)
    finally:
        path.unlink()


def _command(scene: Scene, path: Path, command: list[str]) -> str:
    from hmmseg_cli.main import main

    before = set(os.listdir(scene.folder))
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        arguments = [path.name if part == "@" else part for part in command]
        code = main([*arguments, "--json", "result.json"])
    new = set(os.listdir(scene.folder)) - before
    if code == 2:
        assert not new, f"exit 2 wrote {sorted(new)}"
        line = err.getvalue().strip().split("\n")[-1]
        assert line, "exit 2 without a line"
    else:
        assert code == 0, f"exit {code}"
        json.loads((scene.folder / "result.json").read_text(), parse_constant=lambda c: _refuse(c))
    for made in new:
        (scene.folder / made).unlink()
    return f"exit {code}"


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} in JSON")


def damaged(scene: Scene, rng: np.random.Generator) -> tuple[str, bytes]:
    """A file and its damaged content."""
    name = str(rng.choice(list(scene.good)))
    kinds = TEXTS if name.endswith((".toml", ".json")) else TABLES if name.endswith(".csv") else BINARIES
    data = scene.good[name]
    for _ in range(int(rng.integers(1, 3))):
        data = kinds[int(rng.integers(0, len(kinds)))](data, rng)
    return name, data


def run(cases: int, seed: int, keep: Path | None = None, commands: float = 0.02, limit: int = 20) -> dict:
    """Outcomes of so many cases, a share of them through the commands; at most `limit` failures are kept."""
    outcomes: collections.Counter[str] = collections.Counter()
    failures: list[dict] = []
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = Scene(Path(folder))
        os.chdir(folder)
        started = shown = time.monotonic()
        try:
            for k in range(cases):
                rng = np.random.default_rng([seed, k])
                name, data = damaged(scene, rng)
                runs = COMMANDS.get(name, [])
                command = runs[int(rng.integers(0, len(runs)))] if runs and rng.random() < commands else None
                try:
                    outcomes[one_case(scene, name, data, command)] += 1
                except Exception as error:  # whatever it is, it is a bug
                    failures.append({"case": k, "file": name, "command": command, "error": repr(error)[:500],
                                     "trace": traceback.format_exc()[-1500:]})  # fmt: skip
                    if keep is not None:
                        (here / keep).mkdir(parents=True, exist_ok=True)
                        (here / keep / f"{k}-{name}").write_bytes(data)
                    if len(failures) >= limit:
                        break
                if time.monotonic() - shown > 10:
                    shown = time.monotonic()
                    print(
                        f"{k + 1} cases in {shown - started:.0f} s, {len(failures)} failures", file=sys.stderr
                    )
        finally:
            os.chdir(here)
    return {
        "cases": sum(outcomes.values()) + len(failures),
        "seed": seed,
        "outcomes": dict(outcomes),
        "failures": failures,
    }


def main() -> int:
    """Run and tell; 1 where a case failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files of cases that failed")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = run(given.cases, given.seed, given.keep)
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{found['cases']} cases: {found['outcomes']}, {len(found['failures'])} failures")
    for failure in found["failures"]:
        print(f"case {failure['case']}: {failure['file']} {failure['command'] or ''}\n{failure['trace']}")
    return int(bool(found["failures"]))


if __name__ == "__main__":
    sys.exit(main())
