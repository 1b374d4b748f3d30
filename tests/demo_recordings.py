"""The recordings that come with the package, as tests read them: a rig, its task and four trials."""

from pathlib import Path

import commands
from hmmseg.rig import read_rig
from hmmseg.task import BlockTask, read_task
from hmmseg.trial import read_trial

FOLDER = Path(commands.__file__).parent / "demo_data"
RIG, TASK = read_rig(FOLDER / "rig.toml"), read_task(FOLDER / "task.toml")
assert isinstance(TASK, BlockTask)
TRIALS = [read_trial(FOLDER / f"trial_{k:02d}.csv", RIG) for k in (1, 2, 3, 4)]
