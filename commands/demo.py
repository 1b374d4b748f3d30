"""`hmmseg demo`: identify the blocks of recordings that come with the package, figures included."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from commands.console import JsonOption, Output, QuietOption, SeedOption
from commands.identify import Method, run

DATA = Path(__file__).parent / "demo_data"

DemoFigures = Annotated[Path, typer.Option("--figures", metavar="DIR", help="Folder for the figures.")]


def demo(figures: DemoFigures = Path("demo"), json: JsonOption = None, seed: SeedOption = 0,
         quiet: QuietOption = False) -> None:  # fmt: skip
    """Identify two blocks from recordings that come with the package; figures and a page in demo/."""
    page = figures / "report.html"
    figures.mkdir(parents=True, exist_ok=True)
    with Output("demo", json=json, figures=figures, report=page, seed=seed, quiet=quiet) as out:
        trials = sorted(DATA.glob("trial_*.csv"))
        run(out, trials, DATA / "task.toml", DATA / "rig.toml", Method.BAYES, DATA / "actual.toml")
        out.print(f"figures are in {figures}, all of it on one page in {page}")
