"""The virtual model of a hand and its blocks, and the gap between it and a recording."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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
    "simulate": "simgap.api",
}


def __getattr__(name: str) -> Any:
    if name == "effects":
        return importlib.import_module("simgap.effects")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
