"""The virtual model of a hand and its blocks, and the gap between it and a recording.

Names that are not listed here are internal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hmmseg._lazy import lazily

if TYPE_CHECKING:
    from simgap import effects
    from simgap.api import diagnose, simulate
    from simgap.gap.diagnose import Diagnosis
    from simgap.world.properties import Block
    from simgap.world.simulate import SimulatedTrial
    from simgap.world.virtual_model import VirtualModel

__all__ = ["Block", "Diagnosis", "SimulatedTrial", "VirtualModel", "diagnose", "effects", "simulate"]

_HOMES = {
    "Block": "simgap.world.properties",
    "Diagnosis": "simgap.gap.diagnose",
    "SimulatedTrial": "simgap.world.simulate",
    "VirtualModel": "simgap.world.virtual_model",
    "diagnose": "simgap.api",
    "effects": "simgap.effects",
    "simulate": "simgap.api",
}

__getattr__, __dir__ = lazily(__name__, _HOMES)
