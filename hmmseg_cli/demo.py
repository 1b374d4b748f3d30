"""`hmmseg demo`: identify and diagnose recordings that come with the package, figures included."""

from pathlib import Path

from hmmseg.example import example_folder
from hmmseg.io.rig import read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg_cli import diagnose, identify
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output


def demo(figures: opt.DemoFigures = Path("demo"), json: opt.Json = None, seed: opt.Seed = 0,
         quiet: opt.Quiet = False) -> None:  # fmt: skip
    """Identify two blocks, then find out why rigid fingertips would measure them too narrow; see demo/."""
    page, finding = figures / "report.html", figures / "diagnosis.html"
    with Output("demo", json=json, figures=figures, report=page, seed=seed, quiet=quiet) as out:
        folder = example_folder()
        trials, actual = sorted(folder.glob("trial_*.csv")), folder / "actual.toml"
        task, rig = read_task(folder / "task.toml"), read_rig(folder / "rig.toml")
        assert isinstance(task, BlockTask)
        body = identify.run(out, trials, task, rig, "bayes", actual)
        rigid = rig.fingertip.model_copy(update={"normal_stiffness": float("inf")})
        out.print("\nThe same recordings, with fingertips assumed rigid as in the paper:")
        out.report = finding
        paper = rig.model_copy(update={"fingertip": rigid})
        body["diagnosis"] = diagnose.run(out, trials, task, paper, None, []).body
        out.print(f"figures are in {figures}; the findings are in {page} and {finding}")
        out.finish(body)
