"""Results of the robustness sweeps as figures need them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.plot.style import BLUE, GREEN, ORANGE, RED
from paper_figs.results import FIGURES, ROOT

RESULTS = ROOT / "experiments/results/sweeps/full.json"
# Method: label, colour, marker.
METHODS = {
    "paper": ("baseline, paper's thresholds", RED, "s"),
    "hindsight": ("baseline, best thresholds in hindsight", ORANGE, "D"),
    "unconstrained": ("unconstrained HMM", GREEN, "^"),
    "ours": ("ours", BLUE, "o"),
}


def load(path: Path = RESULTS) -> dict[str, Any]:
    """The sweeps' results."""
    return json.loads(path.read_text(encoding="utf-8"))


def target(name: str) -> Path:
    """Where a figure goes."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    return FIGURES / f"{name}.png"


def method(cell: dict[str, Any], name: str) -> dict[str, Any]:
    """Measures of a method of METHODS in one cell."""
    methods = cell["methods"]
    return methods["qualitative"][len(methods["qualitative"]) // 2] if name == "paper" else methods[name]


def value(entry: dict[str, Any] | None) -> float:
    """A measure's value; infinite where more went missing than it asks for, NaN where there is none."""
    if entry is None:
        return np.nan
    return np.inf if entry["value"] is None else entry["value"]


def series(found: dict[str, Any], sweep: str, name: str, key: str) -> np.ndarray:
    """Levels, values and both ends of the intervals (4, num_levels) of one line."""
    out = []
    for row in found["sweeps"][sweep]:
        entry = method(found["cells"][row["cell"]], name).get(key)
        low, high = (np.nan, np.nan) if entry is None else entry["interval_95"]
        ends = [np.inf if end is None else end for end in (low, high)]
        out.append([row["level"], value(entry), *ends])
    return np.array(sorted(out)).T
