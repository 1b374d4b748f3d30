"""The candidate effects: each `HandEffect` defined in a module of this package, found automatically."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from hmmseg.errors import InputError, nearest
from simgap.channels import channel_effects
from simgap.effects.base import HandEffect, of_forces


@cache
def catalogue() -> dict[str, HandEffect]:
    """All effects by name, in alphabetical order."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    effects = {e.name: e for each in modules for e in vars(each).values() if isinstance(e, HandEffect)}
    # Effects on any channel act on forces, except where hands have effects of that name.
    on_forces = (of_forces(channel) for channel in channel_effects().values())
    effects = {e.name: e for e in on_forces if e.correct or e.name in effects} | effects
    return dict(sorted(effects.items()))


def effect_named(name: str) -> HandEffect:
    """The effect of this name; InputError with the nearest one otherwise."""
    known = catalogue()
    if name not in known:
        raise InputError(f"effect {name!r}", "unknown effect", nearest(name, list(known)))
    return known[name]


def name_of(key: str) -> str:
    """Name of the effect that a key stands for: NAME, or NAME/1, NAME/2, ... for its other forms."""
    return key.split("/")[0]


def free_parameters(key: str) -> tuple[str, ...]:
    """Free parameters of a form of an effect."""
    effect, _, form = catalogue()[name_of(key)], *key.partition("/")[1:]
    return effect.forms[int(form or 0)] if effect.forms else tuple(effect.parameters)


def forms_of(name: str) -> list[str]:
    """Keys of all forms of an effect."""
    return [name, *(f"{name}/{k}" for k in range(1, len(catalogue()[name].forms)))]
