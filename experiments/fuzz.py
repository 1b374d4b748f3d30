"""Hostile input to every reader and command, in process: each must give a result or a one-line InputError.

    python -m experiments.fuzz [--cases 100000] [--seed 0] [--commands 0.02] [--keep FOLDER]

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
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.fuzz_files import BINARIES, TABLES, TEXTS, Scene
from hmmseg.errors import InputError

HAND = ("--task", "task.toml", "--rig", "rig.toml")
LAB = ("--task", "lab-task.toml", "--rig", "lab-rig.toml")  # of recordings that fit their task
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
    "properties.json": [["simulate", *LAB, "--properties", "@", "--output", "made"]],
    "model.npz": [["segment", "trial.csv", "--task", "sequence.toml", "--model", "@"]],
    "lab.csv": [["watch", *LAB], ["watch", *LAB, "--skip-bad-rows"], ["segment", "@", *LAB],
                ["identify", "@", *LAB], ["simulate", *LAB, "--replay", "@", "--output", "made"]],
    "lab-rig.toml": [["watch", "--task", "lab-task.toml", "--rig", "@"],
                     ["identify", "lab.csv", "--task", "lab-task.toml", "--rig", "@"],
                     ["diagnose", "lab.csv", "--task", "lab-task.toml", "--rig", "@"]],
    "lab-task.toml": [["identify", "lab.csv", "--task", "@", "--rig", "lab-rig.toml"],
                      ["simulate", "--task", "@", "--rig", "lab-rig.toml", "--output", "made"],
                      ["watch", "--task", "@", "--rig", "lab-rig.toml"]],
}  # fmt: skip
STREAM = "lab.csv"  # what `watch` reads where its input is not the damaged file


def one_case(scene: Scene, name: str, data: bytes, command: list[str] | None) -> str:
    """ "read", "refused" or "exit N"; a case that fails raises AssertionError or another exception."""
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
    stream = path if command[0] == "watch" and "@" not in command else scene.folder / STREAM
    with _standard_input(stream), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        arguments = [path.name if part == "@" else part for part in command]
        code = main([*arguments, "--json", "result.json"])
    new = set(os.listdir(scene.folder)) - before
    if code == 2:
        assert "Traceback" not in err.getvalue()
        assert not new, f"exit 2 wrote {sorted(new)}"
        line = err.getvalue().strip().split("\n")[-1]
        assert line, "exit 2 without a line"
    else:
        assert code == 0, f"exit {code}"
        json.loads((scene.folder / "result.json").read_text(), parse_constant=lambda c: _refuse(c))
    for made in new:
        each = scene.folder / made
        shutil.rmtree(each) if each.is_dir() else each.unlink()
    return f"exit {code}"


@contextlib.contextmanager
def _standard_input(path: Path) -> Iterator[None]:
    """Replace standard input by a file."""
    usual = sys.stdin
    with path.open("rb") as file:
        sys.stdin = io.TextIOWrapper(io.BytesIO(file.read()))
    try:
        yield
    finally:
        sys.stdin = usual


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
    """Outcomes of `cases` cases, a share of them run as `commands`; stops after `limit` failures."""
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
    count = sum(outcomes.values()) + len(failures)
    return {"cases": count, "seed": seed, "outcomes": dict(outcomes), "failures": failures}


def main() -> int:
    """Run and report; 1 if a case failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--commands", type=float, default=0.02, help="share of cases that go through a command"
    )
    parser.add_argument("--keep", type=Path, help="folder for the files of cases that failed")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = run(given.cases, given.seed, given.keep, given.commands)
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    print(f"{found['cases']} cases: {found['outcomes']}, {len(found['failures'])} failures")
    for failure in found["failures"]:
        print(f"case {failure['case']}: {failure['file']} {failure['command'] or ''}\n{failure['trace']}")
    return int(bool(found["failures"]))


if __name__ == "__main__":
    sys.exit(main())
