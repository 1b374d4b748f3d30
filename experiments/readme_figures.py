"""The README's figure: run the demo and keep one of its pictures in docs/figures."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs" / "figures"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hmmseg_cli.main", "demo", "--figures", folder, "--quiet"]
        subprocess.run(command, check=True)
        DOCS.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(folder) / "trial_01_segments.png", DOCS / "demo_segments.png")


if __name__ == "__main__":
    main()
