"""Candidate effects on robots: every module of this package with a function `candidates` adds its own."""

from __future__ import annotations

import importlib
import pkgutil
import re
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


def words(name: str) -> tuple[str, str] | None:
    """A candidate in plain words, of a channel or a body by its name, and what to check on the robot; None of
    a model's own parameter."""
    kind, where = re.sub(r":.*\.", ".", name), re.search(r":(.*)\.", name)
    for module in families().values():
        if kind in (known := getattr(module, "WORDS", {})):
            called, check = known[kind]
            return called + (f" ({where[1]})" if where else ""), check
    return None
