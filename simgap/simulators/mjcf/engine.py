"""MuJoCo itself, whose bindings carry no types that a checker could read; its warnings are counted."""

from __future__ import annotations

import importlib
from collections import Counter
from typing import Any

mujoco: Any = importlib.import_module("mujoco")
rollout: Any = importlib.import_module("mujoco.rollout")

_WARNED: Counter[str] = Counter()


def _count(text: str | bytes) -> None:
    """Instead of MuJoCo's own way: a line for each on the terminal, and in a file in the current folder."""
    line = text.decode(errors="replace") if isinstance(text, bytes) else text
    _WARNED[line.split(" Time = ")[0].strip().rstrip(".")] += 1


mujoco.set_mju_user_warning(_count)


def warned() -> list[str]:
    """MuJoCo's warnings since the last call, each once with its count."""
    found = [f"MuJoCo: {text} ({count} times)" for text, count in _WARNED.most_common()]
    _WARNED.clear()
    return found
