"""`hmmseg identify`: block properties with uncertainties, from recordings of one task."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.io.task import BlockTask, read_task
from hmmseg_cli.console import (
    ActualOption,
    FiguresOption,
    JsonOption,
    Output,
    QuietOption,
    ReportOption,
    RigBeside,
    SeedOption,
    TaskBeside,
    TrialsArgument,
    described,
    distinct_trials,
    needed,
    read_trials,
)
from hmmseg_cli.segment import warn_of_misfit


class Method(StrEnum):
    """How properties are estimated."""

    BAYES = "bayes"
    PAPER = "paper"


MethodOption = Annotated[Method, typer.Option(help="Bayesian, or the paper's thresholds and formulas.")]


def identify(
    trials: TrialsArgument, task: TaskBeside = None, rig: RigBeside = None,
    method: MethodOption = Method.BAYES, actual: ActualOption = None, json: JsonOption = None,
    figures: FiguresOption = None, report: ReportOption = None, seed: SeedOption = 0,
    quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Weight, width, height and friction of every block, with uncertainties; trials are pooled."""
    with Output("identify", json=json, figures=figures, report=report, seed=seed, quiet=quiet) as out:
        found, hand = described(trials, task, rig)
        out.finish(run(out, trials, found, needed(hand, trials), method, actual))


def run(
    out: Output, trials: Sequence[Path], task: Path, rig: Path, method: Method, actual: Path | None
) -> dict[str, Any]:
    """Identify, put table, figures and page where `out` has them go, and give the document."""
    paths = distinct_trials(trials)
    description = read_task(task)
    if not isinstance(description, BlockTask):
        raise InputError(str(task), "a plain ordered task has no blocks to identify", "objects and moves")
    from estimation.report import properties_table, read_actual
    from hmmseg.hand.signals import task_space
    from hmmseg.io.rig import read_rig

    hand = read_rig(rig)
    measured = None if actual is None else read_actual(actual, description.objects)
    recordings = read_trials(out, paths, hand)
    signals = [task_space(trial, hand) for trial in recordings]
    if method is Method.PAPER:
        body, segmentations, found = _paper(out, signals, recordings, description)
    else:
        found = _bayes(out, recordings, description, hand)
        body, segmentations = found.to_json(), found.segmentations
    if measured is not None:
        from estimation.report import compare, disagreements

        body["actual"] = compare(body["properties"], measured, hand.tolerance.property or 0.0)
        for line in disagreements(body["properties"], body["actual"]):
            out.warn(line)
    out.print(properties_table(body, measured))
    for key, reason in body["reasons"].items():
        out.print(f"{key}: {reason}")
    for note in body.get("notes", ()):
        out.print(note)
    if out.figures is not None:
        _draw(out, signals, recordings, segmentations, body, found, measured)
    if out.report is not None:
        from hmmseg_cli.pages import identification_page

        page = identification_page(signals, recordings, segmentations, body, found, measured, out.warnings)
        out.stage(out.report).write_text(page, encoding="utf-8")
    return body


def _paper(out: Output, signals, recordings, task: BlockTask):
    from estimation.paper_formulas import estimate_plugin
    from hmmseg.segmentation.thresholds import segment_qualitative

    pairs = zip(recordings, signals, strict=True)
    segmentations = [segment_qualitative(trial, s, task) for trial, s in pairs]
    for segmentation in segmentations:
        warn_of_misfit(out, segmentation)
    estimates = estimate_plugin(signals, segmentations, task)
    body = {"trials": [s.to_json() for s in segmentations], "method": "paper", "sampler": None}
    return body | estimates.to_json(), segmentations, None


def _bayes(out: Output, recordings, task: BlockTask, hand):
    from estimation.identification import identify_aligned
    from hmmseg.segmentation.align import align

    aligned = align(recordings, task, hand)
    with out.progress("sampling the posterior", total=100) as advance:
        done = 0

        def progress(step: int, of: int) -> None:
            nonlocal done
            advance(100 * step // of - done)
            done = 100 * step // of

        found = identify_aligned(aligned, out.seed, progress)
    for warning in found.warnings:
        out.warn(warning)
    return found


def _draw(
    out: Output, signals: Sequence[Any], trials: Sequence[Any], segmentations: Sequence[Any],
    body: dict[str, Any], found: Any, actual: Any,
) -> None:  # fmt: skip
    """Signals with subtasks a trial, estimates, and of a Bayesian result corner and predictive check."""
    from estimation.plots import draw_check, draw_corner, draw_estimates
    from hmmseg.plot.spans import draw_signals

    for i, (s, trial, segmentation) in enumerate(zip(signals, trials, segmentations, strict=True)):
        stem = Path(trial.name).stem
        draw_signals(s, segmentation, out.figure(f"{stem}_segments.png"))
        if found is not None:
            draw_check(found, i, out.figure(f"{stem}_predictive.png"))
    draw_estimates(body["properties"], actual, out.figure("estimates.png"))
    if found is not None and found.names:
        draw_corner(found.draws, found.names, out.figure("corner.png"), actual)
