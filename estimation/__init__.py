"""From subtask spans to block properties with uncertainty: `identify` gives an `Identification`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimation.actual import read_actual
    from estimation.api import identify
    from estimation.identification import Identification

__all__ = ["Identification", "identify", "read_actual"]

_HOMES = {
    "Identification": "estimation.identification",
    "identify": "estimation.api",
    "read_actual": "estimation.actual",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
