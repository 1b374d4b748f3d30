"""The README's figures: pictures of the demo and of a diagnosis of one given faulty robot, in docs/figures.

python -m experiments.readme_figures [ROBOTS]

ROBOTS: the folder of faulty robots of experiments.robots_check.given; without it only the demo's.
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
    for robots in sys.argv[1:]:
        case = Path(robots) / "coulomb"
        logs = sorted(map(str, case.glob("train_*.csv")))
        model = ["--mjcf", str(case / "robot.xml"), "--map", str(case / "map.toml")]
        drawn(["diagnose", *logs, *model], "gap_signal.png", "robot_signal.png")


if __name__ == "__main__":
    main()
