"""From a task description and a recording to subtask spans with uncertain boundaries.

`Task`, `Rig` and `Trial` read what is given; `align` and `segment` find the subtasks. Packages that begin
with an underscore, and names that are not listed here, are internal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hmmseg._lazy import lazily

if TYPE_CHECKING:
    from hmmseg.api import align, decompose, fit, segment
    from hmmseg.errors import InputError
    from hmmseg.example import example_folder
    from hmmseg.io.rig import Rig
    from hmmseg.io.task import Task
    from hmmseg.io.trial import Trial
    from hmmseg.online.watcher import Watcher
    from hmmseg.segmentation.spans import Segmentation

__version__ = "0.2.0.dev0"
__all__ = [
    "InputError",
    "Rig",
    "Segmentation",
    "Task",
    "Trial",
    "Watcher",
    "__version__",
    "align",
    "decompose",
    "example_folder",
    "fit",
    "segment",
]

# Where each public name lives; imported when it is first asked for, so that `import hmmseg` is quick.
_HOMES = {
    "InputError": "hmmseg.errors",
    "Rig": "hmmseg.io.rig",
    "Segmentation": "hmmseg.segmentation.spans",
    "Task": "hmmseg.io.task",
    "Trial": "hmmseg.io.trial",
    "Watcher": "hmmseg.online.watcher",
    "align": "hmmseg.api",
    "decompose": "hmmseg.api",
    "example_folder": "hmmseg.example",
    "fit": "hmmseg.api",
    "segment": "hmmseg.api",
}

__getattr__, __dir__ = lazily(__name__, _HOMES)
