"""The candidate effects: every module of this package that defines EFFECT is one, found by itself."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from hmmseg.errors import InputError, nearest
from simgap.effects.base import Effect


@cache
def catalogue() -> dict[str, Effect]:
    """All effects by name, in alphabetical order."""
    found = {}
    for info in pkgutil.iter_modules(__path__):
        effect = getattr(importlib.import_module(f"{__name__}.{info.name}"), "EFFECT", None)
        if effect is not None:
            found[effect.name] = effect
    return dict(sorted(found.items()))


def effect_named(name: str) -> Effect:
    """The effect of this name; InputError with the nearest one otherwise."""
    known = catalogue()
    if name not in known:
        raise InputError(f"effect {name!r}", "unknown effect", nearest(name, list(known)))
    return known[name]
