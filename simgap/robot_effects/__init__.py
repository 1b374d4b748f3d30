"""Candidate effects on robots: every module of this package with a function `candidates` adds its own."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from types import ModuleType

from simgap.robot_effects.base import RobotEffect, Setting


@cache
def families() -> dict[str, ModuleType]:
    """Modules that make candidates, by name."""
    found = {}
    for info in pkgutil.iter_modules(__path__):
        module = importlib.import_module(f"{__name__}.{info.name}")
        if hasattr(module, "candidates"):
            found[info.name] = module
    return dict(sorted(found.items()))


def candidates(setting: Setting) -> dict[str, RobotEffect]:
    """Every candidate for this simulator and these recordings, by name."""
    made = [effect for module in families().values() for effect in module.candidates(setting)]
    return {effect.name: effect for effect in made}
