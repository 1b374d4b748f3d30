"""Recordings that come with the package, for examples and the demo."""

from __future__ import annotations

from pathlib import Path


def example_folder() -> Path:
    """Folder with `rig.toml`, `task.toml`, `actual.toml` and four recordings `trial_01.csv` and on.

    Two stacked blocks change places, in a simulation of the hand of Dupont et al. 1999, at 20 Hz.

    >>> from hmmseg import Task, example_folder
    >>> sorted(path.name for path in example_folder().glob("*.csv"))
    ['trial_01.csv', 'trial_02.csv', 'trial_03.csv', 'trial_04.csv']
    >>> list(Task.read(example_folder() / "task.toml").objects)
    ['block1', 'block2']
    """
    return Path(__file__).parent / "example_data"
