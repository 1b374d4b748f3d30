"""Where saved results and drawn figures lie."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results" / "paper"
FIGURES = ROOT / "docs" / "figures"


def load(name: str) -> dict[str, Any]:
    """The results that `python -m experiments.paper` saved under this name, less its commit."""
    found = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return {key: value for key, value in found.items() if key != "made_by"}


def target(name: str) -> Path:
    """Where a figure goes."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    return FIGURES / f"{name}.png"
