"""Causes by their plain names, and what to look at on the rig for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simgap.effects.base import Effect


def plain_name(
    effect: str, means: Mapping[str, float] | None = None, rig: Mapping[str, Any] | None = None
) -> str:
    """An effect, or several joined by +, in plain words; `means`: its parameters, `rig`: the model's pads."""
    return " and ".join(_one(name, means or {}, rig or {}) for name in effect.split("+"))


def _one(name: str, means: Mapping[str, float], rig: Mapping[str, Any]) -> str:
    called, _, effect = _words(name)
    own = {k.removeprefix(f"{name}."): v for k, v in means.items()}
    return effect.phrase(own, rig) if own and effect is not None and effect.phrase is not None else called


def checks(effects: Sequence[str]) -> list[str]:
    """What to look at on the rig, one line an effect."""
    return [check for _, check, _ in map(_words, effects) if check]


def _words(name: str) -> tuple[str, str, Effect | None]:
    """An effect's plain name and what to check, "" where nothing is said, and the effect where it is ours."""
    from simgap.robot_effects import words

    robots = words(name)
    if robots is not None:
        return *robots, None
    from simgap.effects import catalogue  # slow to import

    known = catalogue().get(name)
    if known is None:
        return name.replace("_", " "), "", None
    return known.called or name.replace("_", " "), known.check, known
