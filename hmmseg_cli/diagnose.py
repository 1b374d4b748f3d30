"""`hmmseg diagnose`: where the sim-to-real gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, SequenceTask, read_task
from hmmseg.numbers import percent
from hmmseg_cli import options as opt
from hmmseg_cli.console import (
    Grouped,
    Output,
    check_folder,
    distinct_trials,
    find_inputs,
    read_trials,
    refuse,
    require_rig,
)
from hmmseg_cli.robot import OwnSimulator, compare_robot, diagnose_robot
from simgap.report.finding import plain_name, sentence, settles, tables

if TYPE_CHECKING:
    from estimation.report import Actual
    from simgap.effect import Effect
    from simgap.gap.diagnose import Diagnosis
    from simgap.generic.diagnose import GenericDiagnosis

EXAMPLES = """hmmseg diagnose trial_*.csv --report gap.html
hmmseg diagnose log_*.csv --mjcf robot.xml --map map.toml --report gap.html --patch corrected/
hmmseg diagnose new_*.csv --healthy old_*.csv --mjcf robot.xml --map map.toml
hmmseg diagnose trial_*.csv --against simulated/trial_*.csv"""
LISTS = ("--against", "--healthy")  # options that take several files


class Diagnose(Grouped):
    """The command, in which `--against A B` stands for `--against A --against B`; so does `--healthy`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before every further file, as the parser expects it."""
        out: list[str] = []
        taking = ""
        for arg in args:
            if arg.startswith("-"):
                taking = arg if arg in LISTS else ""
            elif taking and out[-1] != taking:
                out.append(taking)
            out.append(arg)
        return super().parse_args(ctx, out)


def diagnose(
    trials: opt.Trials, task: opt.TaskFound = None, rig: opt.RigFound = None, actual: opt.ActualBlocks = None,
    healthy: opt.Healthy = None, simulator: opt.Simulator = None, mjcf: opt.Mjcf = None,
    map_file: opt.Map = None, candidate: opt.Candidate = None, against: opt.Against = None,
    model: opt.ModelOrEmissions = None, effect: opt.Effect = None, patch: opt.Patch = None,
    history: opt.History = None, rerun: opt.Rerun = None, json: opt.Json = None, figures: opt.Figures = None,
    report: opt.Report = None, seed: opt.Seed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """The gap between recordings and a simulation: where it lies, what causes it, how far it shrinks.

    Three models may be on the other side: the virtual blocks, your own model of a robot, or simulated trials.
    """
    with Output("diagnose", json=json, figures=figures, report=report, seed=seed, quiet=quiet) as out:
        paths = distinct_trials(trials)
        if model is not None and mjcf is None and model.suffix.lower() != ".npz":
            model, mjcf = None, model  # a robot's model, not a task's emissions
        own = OwnSimulator(simulator, mjcf, map_file, candidate or [], patch, history, rerun)
        if own.given:
            own.check_alone({"--rig": rig, "--actual": actual, "--against": against, "--model": model})
            if healthy:
                refuse("does not go with --healthy and a model", {"--effect": effect, "--task": task})
                compare_robot(out, paths, distinct_trials([*paths, *healthy])[len(paths) :], own)
            else:
                diagnose_robot(out, paths, own, task, effect or [])
            return
        task, rig = find_inputs(paths, task, rig)
        description = read_task(task)
        if against:
            refuse("does not go with --against", {"--patch": patch, "--healthy": healthy, "--actual": actual})
            _against(out, paths, against, description, rig, effect or [], model)
            return
        if not isinstance(description, BlockTask):
            raise InputError(str(task), "a plain ordered task has no virtual model", "--against SIM")
        refuse("goes only with a plain ordered task", {"--model": model})
        rig = require_rig(rig, paths)
        hand = read_rig(rig)
        if patch is not None:
            check_folder("--patch", patch)
        found = run(out, paths, description, hand, actual, effect or [], healthy or [])
        if patch is not None:
            _patch(out, found, rig, patch)
        out.finish(found.body)


diagnose.cls = Diagnose  # type: ignore[attr-defined]


def _patch(out: Output, found: Diagnosis, rig: Path, folder: Path) -> None:
    """Write the corrected model; only a warning where it would not reduce the gap of held-out trials."""
    from simgap.patch import files

    if (folder / "rig.toml").resolve() == rig.resolve():
        raise InputError(f"--patch {folder}", f"would replace the input {rig}", "another folder")
    written = files(rig.read_text(encoding="utf-8"), found.body)
    if not written:
        out.warn(f"--patch {folder}: no cause was named, so there is nothing to correct; nothing is written")
        return
    fraction = (found.body["shrinkage"] or {}).get("fraction")
    if fraction is not None and fraction <= 0:
        out.warn(f"--patch {folder}: the cause takes nothing off held-out trials; nothing is written")
        return
    for name, text in written.items():
        out.stage(folder / name).write_text(text, encoding="utf-8")
    share = "" if fraction is None else f"; with it the gap shrinks by {percent(fraction)} on held-out trials"
    out.print(
        f"{' and '.join(map(plain_name, found.body['causes']))}: put into {folder / 'rig.toml'}{share}. "
        f"hmmseg simulate takes it with --rig, and the ranges for training are in ranges.json"
    )


def run(
    out: Output, paths: Sequence[Path], task: BlockTask, rig: Rig, actual: Path | None, effect: Sequence[str],
    healthy: Sequence[Path] = (),
) -> Diagnosis:  # fmt: skip
    """Diagnose, and write table, figures and page to the destinations of `out`."""
    from estimation.report import read_actual
    from hmmseg.segmentation.align import align
    from simgap.effects import catalogue
    from simgap.gap.diagnose import STAGES
    from simgap.gap.diagnose import diagnose as find

    measured = None if actual is None else read_actual(actual, task.objects)
    recordings = read_trials(out, paths, rig)
    healthy_trials = read_trials(out, distinct_trials([*paths, *healthy])[len(paths) :], rig)
    with out.progress("diagnosing", total=STAGES) as advance:
        null = align(healthy_trials, task, rig) if healthy_trials else None
        aligned = align(recordings, task, rig)
        found = find(aligned, measured, effect, out.seed, lambda _: advance(1), healthy=null)
    pads = rig.fingertip.model_dump()
    more = settles(found.body, measured is not None)
    out.warn(*found.warnings)
    out.print(sentence(found.body, pads), *filter(None, [more]), *tables(found.body))
    _draw(out, found, [trial.name for trial in recordings], task, catalogue(), pads, measured)
    return found


def _against(
    out: Output, paths: Sequence[Path], against: Sequence[Path], task: BlockTask | SequenceTask,
    rig_file: Path | None, effect: Sequence[str], model_file: Path | None,
) -> None:  # fmt: skip
    """Diagnose the gap to given simulated trials."""
    from hmmseg.sequence.model import load_model
    from simgap.generic.diagnose import check_forced
    from simgap.generic.diagnose import diagnose as compare
    from simgap.generic.effects import effects
    from simgap.generic.trials import align, align_block_trials

    check_forced(effect)
    every, count = distinct_trials([*paths, *against]), len(paths)
    if isinstance(task, BlockTask):
        refuse("goes only with a plain ordered task", {"--model": model_file})
        rig_file = require_rig(rig_file, paths)
    hand = None if rig_file is None else read_rig(rig_file)
    ordered = None if isinstance(task, BlockTask) else task
    read = [*read_trials(out, every[:count], hand, ordered), *_simulated(out, every[count:], hand, ordered)]
    with out.progress("diagnosing", total=3) as advance:
        if isinstance(task, BlockTask):
            assert hand is not None
            ensembles = align_block_trials(read[:count], read[count:], task, hand)
        else:
            learned = None if model_file is None else load_model(model_file, task)
            ensembles = align(read[:count], read[count:], task, learned)
        advance(1)
        found = compare(ensembles, effect, out.seed, lambda _: advance(1))
    out.warn(*found.warnings)
    out.print(sentence(found.body), *tables(found.body))
    _draw(out, found, [trial.name for trial in read[:count]], task, effects())
    out.finish(found.body)


def _simulated(out: Output, paths: Sequence[Path], hand: Rig | None, task: SequenceTask | None) -> list[Any]:
    """Given simulated trials, with the recordings' columns or with ours, as `hmmseg simulate` writes them."""
    try:
        return read_trials(out, paths, hand, task)
    except InputError:
        if hand is not None and hand.columns:
            with suppress(InputError):
                return read_trials(out, paths, hand.model_copy(update={"columns": {}}), task)
        raise


def _draw(
    out: Output, found: Diagnosis | GenericDiagnosis, files: Sequence[str], task: BlockTask | SequenceTask,
    candidates: Mapping[str, Effect], pads: Mapping[str, float] | None = None, measured: Actual | None = None,
) -> None:  # fmt: skip
    """Draw figures and page if wanted; `pads` only against the virtual model, which has them."""
    if out.figures is None and out.report is None:
        return
    from hmmseg.contact.decompose import subtasks
    from hmmseg_cli.pages import Setting, page
    from simgap.report.figures import draw_all

    draw = partial(draw_all, found, list(dict.fromkeys(s.label for s in subtasks(task))))
    if out.figures is not None:
        draw(out.figure)
    if out.report is not None:
        shows = {name: candidate.shows for name, candidate in candidates.items()}
        setting = Setting(files, pads or {}, measured, shows, out.warnings)
        out.stage(out.report).write_text(page(found.body, setting, draw), encoding="utf-8")
