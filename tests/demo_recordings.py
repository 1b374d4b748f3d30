"""Recordings as tests read them: those that come with the package, and those in recordings/."""

from pathlib import Path

from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial

FOLDER, RECORDINGS = example_folder(), Path(__file__).resolve().parents[1] / "recordings"


def recorded(folder: Path | str, count: int) -> tuple[list[Trial], BlockTask, Rig]:
    """The first trials of a folder (of recordings/, if a name), their task and rig."""
    folder = RECORDINGS / folder
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    return [read_trial(folder / f"trial_{k:02d}.csv", rig) for k in range(1, count + 1)], task, rig


TRIALS, TASK, RIG = recorded(FOLDER, 4)
