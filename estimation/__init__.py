"""From subtask spans to block properties with uncertainty: `identify` gives an `Identification`.

Names that are not listed here are internal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hmmseg._lazy import lazily

if TYPE_CHECKING:
    from estimation.api import identify
    from estimation.identification import Identification
    from estimation.report import read_actual

__all__ = ["Identification", "identify", "read_actual"]

_HOMES = {
    "Identification": "estimation.identification",
    "identify": "estimation.api",
    "read_actual": "estimation.report",
}

__getattr__, __dir__ = lazily(__name__, _HOMES)
