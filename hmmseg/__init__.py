"""From a task description and recordings to subtasks, block properties and the gap to a simulation.

`Task`, `Rig` and `Trial` read the inputs; `align` and `segment` find the subtasks, `identify` the properties,
`diagnose` the gap. Names that are not listed here are internal.
"""

from hmmseg._lazy import lazily

__version__ = "0.2.0.dev0"
__getattr__, __dir__, __all__ = lazily(__name__, __file__)
