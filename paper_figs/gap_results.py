"""Results of the blind check as its figures need them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from paper_figs.results import ROOT

RESULTS = ROOT / "experiments" / "results" / "blind_check.json"


def load(path: Path = RESULTS) -> dict[str, Any]:
    """The scored check."""
    return json.loads(path.read_text(encoding="utf-8"))
