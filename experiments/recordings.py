"""The cases of a recordings folder: each has its rig, task, trials and, if known, its truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from estimation.report import read_actual
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial


@dataclass(frozen=True)
class Case:
    """One folder of recordings that share blocks and rig.

    `truth` holds the boundary times [s] of each trial (NaN of one that never came), None where
    unknown. `blocks` are the properties by object: (value, sd) in N and m, sd 0 for the simulation's
    own. `effects` names what was done to the recordings, None where nobody says.
    """

    name: str
    rig: Rig
    task: BlockTask
    trials: tuple[Trial, ...]
    signals: tuple[Signals, ...]
    truth: tuple[tuple[float, ...] | None, ...]
    blocks: dict[str, dict[str, tuple[float, float]]]
    effects: tuple[str, ...] | None

    @property
    def healthy(self) -> bool:
        """Whether the recordings are known to be free of effects."""
        return self.effects == ("none",)


def list_cases(folder: Path) -> list[Path]:
    """Folders of the cases in a recordings folder, which may itself be a case."""
    folder = Path(folder)
    if (folder / "task.toml").exists():
        return [folder]
    found = sorted(path.parent for path in folder.glob("*/task.toml"))
    if not found:
        raise InputError(str(folder), "holds no case", "folders with rig.toml, task.toml and trials")
    return found


def read_case(folder: Path) -> Case:
    """Read a case; true properties come from a neighbouring labels.json if present, else actual.toml."""
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    if not isinstance(task, BlockTask):
        raise InputError(str(folder / "task.toml"), "is a plain ordered task", "objects and moves")
    files = sorted(folder.glob("trial_*.csv"))
    trials = tuple(read_trial(file, rig) for file in files)
    signals = tuple(task_space(trial, rig) for trial in trials)
    truth = tuple(read_boundaries(folder / "truth" / f"{file.stem}.json") for file in files)
    blocks = {}
    if (folder / "actual.toml").exists():
        blocks = read_actual(folder / "actual.toml", task.objects)
    label = _label(folder)
    effects = None
    if label is not None:
        effects = tuple(label["effects"])
        for name, properties in label["blocks"].items():
            entry = {("friction" if key == "mu" else key): (value, 0.0) for key, value in properties.items()}
            blocks[name] = entry
    elif folder.name == "paper_blocks":  # its README: healthy, without an entry in labels.json
        effects = ("none",)
    return Case(folder.name, rig, task, trials, signals, truth, blocks, effects)


def read_boundaries(path: Path) -> tuple[float, ...] | None:
    """True boundaries [s] from a file in truth/, NaN if one never occurred; None without the file."""
    if not path.exists():
        return None
    times = json.loads(path.read_text(encoding="utf-8"))["boundaries"]
    return tuple(float("nan") if time is None else float(time) for time in times)


def _label(folder: Path) -> dict | None:
    path = folder.parent / "labels.json"
    if not path.exists():
        return None
    return next((e for e in json.loads(path.read_text(encoding="utf-8")) if e["case"] == folder.name), None)
