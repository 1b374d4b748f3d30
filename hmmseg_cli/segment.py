"""`hmmseg segment`: recordings to subtask spans with uncertain boundaries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask, read_task
from hmmseg.segmentation.spans import spans_table, trials_table
from hmmseg_cli.batch import SchedulerOption, WorkersOption, recordings_in, segment_apart
from hmmseg_cli.console import (
    FiguresOption,
    JsonOption,
    Output,
    QuietOption,
    RigBeside,
    TaskBeside,
    TrialsArgument,
    UnusedSeed,
    described,
    distinct_trials,
    needed,
    read_trials,
)
from hmmseg_cli.labels import WriteOption, check_destination, write_labels

if TYPE_CHECKING:
    from hmmseg.io.rig import Rig
    from hmmseg.io.task import BlockTask
    from hmmseg.io.trial import Trial
    from hmmseg.segmentation.spans import Question, Segmentation


class Method(StrEnum):
    """How recordings are segmented."""

    HMM = "hmm"
    QUALITATIVE = "qualitative"


ModelFile = Annotated[Path | None, typer.Option(
    "--model", metavar="M.npz", help="Emissions of a plain ordered task, from hmmseg fit.")]  # fmt: skip
ForceThreshold = Annotated[float, typer.Option(
    "--force-threshold", metavar="N", min=0.0, help="Qualitative method: of forces [N].")]  # fmt: skip
VelocityThreshold = Annotated[float, typer.Option(
    "--velocity-threshold", metavar="M/S", min=0.0, help="Qualitative method: velocities.")]  # fmt: skip


def segment(
    trials: TrialsArgument, task: TaskBeside = None, rig: RigBeside = None, model: ModelFile = None,
    method: Annotated[Method, typer.Option(help="hmm, or the paper's thresholds.")] = Method.HMM,
    force_threshold: ForceThreshold = 0.05, velocity_threshold: VelocityThreshold = 0.05,
    write: WriteOption = None, json: JsonOption = None, figures: FiguresOption = None, seed: UnusedSeed = 0,
    quiet: QuietOption = False, workers: WorkersOption = None, scheduler: SchedulerOption = None,
) -> None:  # fmt: skip
    """Segment recordings into the task's subtasks, with the uncertainty of every boundary.

    With --workers or --scheduler each recording is fitted by itself, not pooled with the others, and a folder
    means all recordings in it.
    """
    with Output("segment", json=json, figures=figures, seed=seed, quiet=quiet) as out:
        apart = workers is not None or scheduler is not None
        paths = distinct_trials(recordings_in(trials) if apart else trials)
        check_destination(write, paths)
        task, rig = described(paths, task, rig)
        description = read_task(task)
        if isinstance(description, SequenceTask):
            if apart:
                raise InputError("--workers, --scheduler", "go with tasks of blocks alone")
            recordings, found = _segment_sequence(out, paths, description, rig, model, method)
        else:
            rig = needed(rig, paths)
            if model is not None:
                raise InputError(f"--model {model}", "goes only with a plain ordered task")
            if apart:
                if write is not None or figures is not None or method is not Method.HMM:
                    raise InputError("--workers, --scheduler", "go with --json alone")
                recordings, found = [], _segment_apart(out, paths, task, rig, workers, scheduler)
            else:
                thresholds = (force_threshold, velocity_threshold)
                recordings, found = _segment_blocks(
                    out, paths, description, rig, method, thresholds, figures is None and write is None
                )
        if apart:
            out.print(trials_table(found))
        for segmentation in found:
            if not apart:
                out.print(spans_table(segmentation))
            warn_of_misfit(out, segmentation)
        warn_of_rig(out, found)
        question = ask(out, found)
        if write is not None:
            write_labels(out, write, paths, recordings, found)
        open_ones = {} if question is None else {"question": asdict(question)}
        out.finish({"method": method.value, "trials": [s.to_json() for s in found]} | open_ones)


def _segment_blocks(
    out: Output, paths, task, rig_file: Path, method: Method, thresholds, lean: bool
) -> tuple[list[Trial], list[Segmentation]]:
    from hmmseg.hand.signals import task_space
    from hmmseg.io.rig import read_rig
    from hmmseg.segmentation.thresholds import segment_qualitative

    rig = read_rig(rig_file)
    if lean and method is Method.HMM and _on_disk(paths, task, rig):
        return [], _segment_long(out, paths, task, rig)
    recordings = read_trials(out, paths, rig)
    signals = [task_space(trial, rig) for trial in recordings]
    if method is Method.QUALITATIVE:
        pairs = zip(recordings, signals, strict=True)
        found = [segment_qualitative(trial, s, task, *thresholds) for trial, s in pairs]
    else:
        from hmmseg.segmentation.align import segment

        found = segment(recordings, task, rig)
    if out.figures is not None:
        from hmmseg.plot.spans import draw_signals

        for trial, s, segmentation in zip(recordings, signals, found, strict=True):
            draw_signals(s, segmentation, out.figure(f"{trial.stem}_segments.png"))
    return recordings, found


def _segment_apart(
    out: Output, paths: Sequence[Path], task: Path, rig: Path, workers: int | None, scheduler: str | None
) -> list[Segmentation]:
    """Each recording by itself, in other processes."""
    found = []
    with out.progress("segmenting", len(paths)) as advance:
        for each in segment_apart(paths, task, rig, workers, scheduler, advance, out.warn):
            for warning in each.warnings:
                out.warn(warning)
            for note in each.notes:
                out.print(note)
            found.append(each.segmentation)
    if not found:
        raise InputError(str(paths[0]), "the process that segmented it was killed, as of all others",
                         "enough memory, or fewer --workers")  # fmt: skip
    return found


def _on_disk(paths: Sequence[Path], task: BlockTask, rig: Rig) -> bool:
    """Whether recordings are of a repeated task and too long to be read at once."""
    from hmmseg.hand.read import is_long

    return task.repeat != 1 and rig.gripper is None and all(is_long(path) for path in paths)


def _segment_long(out: Output, paths: Sequence[Path], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Each recording by itself, from disk; what cannot be is judged by its beginning."""
    from hmmseg.hand.read import LongRecording, check
    from hmmseg.segmentation.align import segment_long

    found = []
    for path in paths:
        recording = LongRecording(path, rig)
        for warning in check(recording.beginning(), rig):
            out.warn(warning)
        found.append(segment_long(recording, task, rig))
    return found


def _segment_sequence(
    out: Output, paths, task: SequenceTask, rig_file, model_file, method: Method
) -> tuple[list[Trial], list[Segmentation]]:
    from hmmseg.io.rig import read_rig
    from hmmseg.sequence.model import load_model
    from hmmseg.sequence.segment import segment_sequence

    if method is Method.QUALITATIVE:
        raise InputError("--method qualitative", "needs a task of blocks", "--method hmm")
    recordings = read_trials(out, paths, None if rig_file is None else read_rig(rig_file), task)
    learned = None if model_file is None else load_model(model_file, task)
    found = segment_sequence(recordings, task, learned)
    if out.figures is not None:
        from hmmseg.plot.spans import draw_channels

        for trial, segmentation in zip(recordings, found, strict=True):
            draw_channels(trial, segmentation, out.figure(f"{trial.stem}_segments.png"))
    return recordings, found


def ask(out: Output, found: Sequence[Segmentation]) -> Question | None:
    """Say that boundaries may lie elsewhere, and which label would decide most, if so."""
    from hmmseg.segmentation.spans import most_telling

    question = most_telling(found)
    if question is not None:
        name = Path(question.trial).name
        out.warn(
            f"some boundaries could as well be elsewhere; most would be decided by the start of "
            f"{question.subtask} in {name}, given to hmmseg fit --labels"
        )
    return question


def warn_of_misfit(out: Output, segmentation: Segmentation) -> None:
    """Say which subtask a trial fails at, if it does, in every repetition that does."""
    failed = () if segmentation.failed is None else (segmentation.failed,)
    for failure in segmentation.failures or failed:
        out.warn(f"{segmentation.file}: {failure}")


def warn_of_rig(out: Output, found: Sequence[Segmentation]) -> None:
    """Say once what the recordings contradict the rig in."""
    for remark in dict.fromkeys(remark for segmentation in found for remark in segmentation.remarks):
        out.warn(remark)
