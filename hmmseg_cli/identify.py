"""`hmmseg identify`: block properties with uncertainties, from recordings of one task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, distinct_trials, find_inputs, read_trials, require_rig
from hmmseg_cli.segment import warn_of_misfits

if TYPE_CHECKING:
    from estimation.identification import Identification
    from hmmseg.io.trial import Trial
    from hmmseg.segmentation.spans import Segmentation


def identify(
    trials: opt.Trials, task: opt.TaskFound = None, rig: opt.RigFound = None,
    method: opt.IdentifyMethod = "bayes", actual: opt.Actual = None, json: opt.Json = None,
    figures: opt.Figures = None, report: opt.Report = None, seed: opt.Seed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Weight, width, height and friction of every block, with uncertainties; trials are pooled."""
    with Output("identify", json=json, figures=figures, report=report, seed=seed, quiet=quiet) as out:
        found, hand = find_inputs(trials, task, rig)
        description = read_task(found)
        if not isinstance(description, BlockTask):
            problem = "a plain ordered task has no blocks to identify"
            raise InputError(str(found), problem, "objects and moves")
        out.finish(run(out, trials, description, read_rig(require_rig(hand, trials)), method, actual))


def run(
    out: Output, trials: Sequence[Path], task: BlockTask, hand: Rig, method: opt.Estimator, actual: opt.File
) -> dict[str, Any]:
    """Identify, write table, figures and page to the destinations of `out`, and return the document."""
    from estimation.report import compare, disagreements, properties_table, read_actual

    paths, found = distinct_trials(trials), None
    measured = None if actual is None else read_actual(actual, task.objects)
    recordings = read_trials(out, paths, hand)
    if method == "paper":
        body, segmentations = _paper(out, recordings, task, hand)
    else:
        found = _bayes(out, recordings, task, hand)
        body, segmentations = found.to_json(), found.segmentations
    if measured is not None:
        body["actual"] = compare(body["properties"], measured, hand.tolerance.property or 0.0)
        out.warn(*disagreements(body["properties"], body["actual"]))
    reasons = (f"{key}: {reason}" for key, reason in body["reasons"].items())
    out.print(properties_table(body, measured), *reasons, *body.get("notes", ()))
    if out.figures is not None:
        from estimation.plots import draw_check, draw_corner, draw_estimates

        for i, (trial, segmentation) in enumerate(zip(recordings, segmentations, strict=True)):
            segmentation.plot(out.figure(f"{Path(trial.name).stem}_segments.png"))
            if found is not None:
                draw_check(found, i, out.figure(f"{Path(trial.name).stem}_predictive.png"))
        draw_estimates(body["properties"], measured, out.figure("estimates.png"))
        if found is not None and found.names:
            draw_corner(found.draws, found.names, out.figure("corner.png"), measured)
    if out.report is not None:
        from hmmseg_cli.pages import identification_page

        page = identification_page(recordings, segmentations, body, found, measured, out.warnings)
        out.stage(out.report).write_text(page, encoding="utf-8")
    return body


def _paper(
    out: Output, recordings: Sequence[Trial], task: BlockTask, hand: Rig
) -> tuple[dict[str, Any], list[Segmentation]]:
    """The paper's thresholds and formulas: body of the document, and segmentations."""
    from estimation.paper_formulas import estimate_plugin
    from hmmseg.hand.signals import task_space
    from hmmseg.segmentation.thresholds import segment_qualitative

    signals = [task_space(trial, hand) for trial in recordings]
    pairs = zip(recordings, signals, strict=True)
    segmentations = [segment_qualitative(trial, s, task) for trial, s in pairs]
    warn_of_misfits(out, segmentations)
    properties, reasons = estimate_plugin(signals, segmentations, task)
    body = {"trials": [s.to_json() for s in segmentations], "method": "paper", "sampler": None}
    return body | {"properties": properties, "reasons": reasons}, segmentations


def _bayes(out: Output, recordings: Sequence[Trial], task: BlockTask, hand: Rig) -> Identification:
    from estimation.identification import identify_aligned
    from estimation.sampler import CHUNK, MAX_STEPS
    from hmmseg.segmentation.align import align

    aligned = align(recordings, task, hand)
    with out.progress("sampling the posterior", total=MAX_STEPS) as advance:
        found = identify_aligned(aligned, out.seed, lambda *_: advance(CHUNK))
    out.warn(*found.warnings)
    return found
