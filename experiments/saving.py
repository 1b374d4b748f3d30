"""Results as JSON with the commit of the code that made them, and plain figures of them."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
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
    """Write a result with `made_by`, the commit of this code; ValueError if it contains NaN."""
    text = json.dumps({**document, "made_by": commit_of()}, indent=1, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")


@contextmanager
def panels(path: Path, *shape: int, **options: Any) -> Iterator[Any]:
    """The axes of a figure (arguments of `matplotlib.pyplot.subplots`), which is then saved to `path`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(*shape, layout="constrained", **options)
    yield axes
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
