"""Paths of saved results and figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results" / "paper"
FIGURES = ROOT / "docs" / "figures"


def load(name: str) -> dict[str, Any]:
    """Results saved by `python -m experiments.paper` under a name, without their commit."""
    found = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return {key: value for key, value in found.items() if key != "made_by"}


def target(name: str) -> Path:
    """Path of a figure."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    return FIGURES / f"{name}.png"
