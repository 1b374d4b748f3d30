"""Synthetic trials as texts of files: rig, task, actual properties, trials and their truth."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import tomlkit

from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from simgap.world.properties import UNITS, Blocks

DIGITS = {"q": 6, "d": 5, "x": 7, "y": 7, "v": 6, "f": 5}  # numerics: decimals by a channel's first letter


def scene_files(task: BlockTask, rig: Rig, blocks: Blocks) -> dict[str, str]:
    """Texts of rig.toml, task.toml and actual.toml by file name."""
    actual = {
        name: {key: {"unit": unit, "value": float(getattr(blocks[name], key))} for key, unit in UNITS.items()}
        for name in task.objects
    }
    return {"rig.toml": tomlkit.dumps(rig.model_dump(exclude_none=True, exclude_defaults=True)),
            "task.toml": tomlkit.dumps(task_table(task)), "actual.toml": tomlkit.dumps(actual)}  # fmt: skip


def trial_files(number: int, trial: Trial, boundaries: np.ndarray, seed: int) -> dict[str, str]:
    """Texts of one trial and its truth (boundaries [s], null where one never happened) by file name."""
    times = [round(float(b), 6) if np.isfinite(b) else None for b in boundaries]
    truth = json.dumps({"boundaries": times, "seed": int(seed)})
    return {f"trial_{number:02d}.csv": trial_csv(trial), f"truth/trial_{number:02d}.json": truth + "\n"}


def trial_csv(trial: Trial) -> str:
    """A trial as CSV text: t and the hand's channels, rounded below the sensors' noise; empty if missing."""
    rows = [f"{t:.6f}" for t in trial.t]
    for name, values in trial.channels.items():
        digits = DIGITS[name[0]]
        cells = (f"{value:.{digits}f}" if np.isfinite(value) else "" for value in values)
        rows = [f"{row},{cell}" for row, cell in zip(rows, cells, strict=True)]
    return "\n".join([",".join(["t", *trial.channels]), *rows]) + "\n"


def task_table(task: BlockTask) -> dict[str, Any]:
    """The table of `task.toml` that describes a task."""
    moves = [{"object": m.object, "to": m.to} | ({"slide": True} if m.slide else {}) for m in task.moves]
    table: dict[str, Any] = {} if task.repeat == 1 else {"repeat": task.repeat}
    return table | {"objects": {name: {"on": on} for name, on in task.initial.items()}, "moves": moves}
