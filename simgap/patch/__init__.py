"""From a diagnosis to a corrected virtual model: rig.toml with what was found, and ranges for training.

`files` writes what `hmmseg diagnose --patch` puts into its folder; `replayed` and `performed` are the
virtual model with a corrected rig, whose `[effects]` they apply.
"""

from simgap.patch.model import performed, replayed
from simgap.patch.write import files

__all__ = ["files", "performed", "replayed"]
