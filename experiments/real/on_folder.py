"""The command line of an experiment on one folder of recordings by others."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.saving import save


def run_on_folder(doc: str, run: Callable[[Path], Any], results: Path) -> Any:
    """Parse FOLDER and --output, run, write what `run` gives as JSON and return it; ValueError for NaN."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path, default=results)
    given = parser.parse_args()
    document = run(given.folder)
    save(given.output, document)
    return document
