"""The README's figures: pictures of the demo and of a calibrated servo, in docs/figures.

python -m experiments.readme_figures [LOGS]

LOGS: the folder of the servo's logs of experiments.real.xl330_sheet; without it only the demo's.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs" / "figures"


def drawn(words: list[str], picture: str, name: str) -> None:
    """Run a command of ours with --figures and keep one of its pictures under a name."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "hmmseg_cli.main", *words, "--figures", folder, "--quiet"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        DOCS.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(folder) / picture, DOCS / name)


def main() -> None:
    """Draw them."""
    drawn(["demo"], "trial_01_segments.png", "demo_segments.png")
    for logs in sys.argv[1:]:
        script = [sys.executable, "-m", "experiments.real.xl330_sheet"]
        subprocess.run([*script, logs, "--figure", str(DOCS / "servo.png")], check=True)


if __name__ == "__main__":
    main()
