"""Helpers for the tables of README.md and docs/: results by name, cells, Markdown."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def load(name: str) -> dict | None:
    """A saved result by its file's stem; None if it was not written yet."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with its first column to the left, the others to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def as_csv(text: str) -> str:
    """The tables of a text as comma-separated values; text between them becomes lines of one cell."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    for line in filter(None, map(str.strip, text.splitlines())):
        if not line.startswith("|"):
            write.writerow([line.lstrip("# ")])
        elif not set(line) <= set("|-: "):
            write.writerow([cell.strip().replace("`", "") for cell in line[1:-1].split("|")])
    return out.getvalue()


def percent(value: float, digits: int = 1) -> str:
    """A share as a percentage."""
    return f"{100 * value:.{digits}f} %"


def covered(entry: dict, name: str) -> str:
    """A coverage with its standard error over cases."""
    error = entry[f"{name}_se"]
    return f"{100 * entry[name]:.1f}" + ("" if error is None else f" ± {100 * error:.1f}") + " %"


def milliseconds(value: float) -> str:
    """Seconds as ms."""
    return f"{1e3 * value:.1f} ms"
