"""Results as JSON, with the commit of the code that made them."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def commit_of(root: Path = ROOT) -> str | None:
    """The commit of a checkout, with a plus sign where its code was changed since; None outside of one.

    Results and figures that were made again since are no change of the code.
    """

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        commit = git("rev-parse", "--short=12", "HEAD")
        return commit + "+" * bool(git("status", "--porcelain", "--", "*.py", "*.toml"))
    except (OSError, subprocess.CalledProcessError):
        return None


def save(path: Path, document: dict[str, Any]) -> None:
    """Write a result with `made_by`, the commit of this code; ValueError where it holds NaN."""
    text = json.dumps({**document, "made_by": commit_of()}, indent=1, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")
