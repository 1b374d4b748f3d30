"""Results of a sweep on disk: one file a unit of work, there in full or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

SUFFIX = ".json"


class Store:
    """A folder with one JSON file for every finished unit, named by the unit's key.

    A file is written aside and moved into place, so an interruption leaves no half of one, and a
    unit finished twice is still there once.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def finished(self) -> set[str]:
        """Keys of all finished units."""
        return {path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"*{SUFFIX}")}

    def write(self, key: str, result: Any) -> None:
        """Keep the result of a unit; ValueError where it holds NaN or infinity."""
        aside = self.folder / f".{key}.{os.getpid()}"
        with aside.open("w", encoding="utf-8") as file:
            json.dump(result, file, allow_nan=False, separators=(",", ":"))
            file.flush()
            os.fsync(file.fileno())
        aside.replace(self.folder / f"{key}{SUFFIX}")

    def read(self, key: str) -> Any:
        """Result of a finished unit; FileNotFoundError for any other."""
        return json.loads((self.folder / f"{key}{SUFFIX}").read_text(encoding="utf-8"))

    def clear(self) -> None:
        """Forget every unit."""
        for key in self.finished():
            (self.folder / f"{key}{SUFFIX}").unlink()
