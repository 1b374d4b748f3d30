"""The recordings that come with the package, as tests read them: a rig, its task and four trials."""

from hmmseg.example import example_folder
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.task import BlockTask, read_task

FOLDER = example_folder()
RIG, TASK = read_rig(FOLDER / "rig.toml"), read_task(FOLDER / "task.toml")
assert isinstance(TASK, BlockTask)
TRIALS = [read_trial(FOLDER / f"trial_{k:02d}.csv", RIG) for k in (1, 2, 3, 4)]
