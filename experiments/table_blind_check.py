"""Table of the blind check."""

from __future__ import annotations

from experiments.blind_check.tables import table as check_table
from experiments.table_text import load


def table() -> str | None:
    """docs/gap_results.md: the published figures."""
    found = load("blind_check")
    return None if found is None else check_table(found)
