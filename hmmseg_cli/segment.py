"""`hmmseg segment` and `hmmseg fit`: recordings to subtask spans, and what is learned first.

`--labels` of `fit` gives known boundaries: a folder with NAME.json for some trials, {"boundaries": [times in
s, null where unknown]}, or a CSV or TSV file with the columns trial, subtask and start [s].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, SequenceTask, read_task
from hmmseg.segmentation.spans import Segmentation, most_telling, spans_table, trials_table
from hmmseg_cli import options as opt
from hmmseg_cli.batch import recordings_in, segment_apart
from hmmseg_cli.console import Output, check_file, distinct_trials, find_inputs, read_trials, require_rig

if TYPE_CHECKING:
    from hmmseg.io.trial import Trial


def segment(
    trials: opt.Trials, task: opt.TaskFound = None, rig: opt.RigFound = None, model: opt.LearnedModel = None,
    method: opt.SegmentMethod = "hmm", force_threshold: opt.ForceThreshold = 0.05,
    velocity_threshold: opt.VelocityThreshold = 0.05, write: opt.WrittenLabels = None, json: opt.Json = None,
    figures: opt.Figures = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False,
    workers: opt.Workers = None, scheduler: opt.Scheduler = None,
) -> None:  # fmt: skip
    """Segment recordings into the task's subtasks, with the uncertainty of every boundary.

    With --workers or --scheduler each recording is fitted by itself, not pooled with the others, and a folder
    means all recordings in it.
    """
    from hmmseg_cli.labels import check_destination, write_labels

    with Output("segment", json=json, figures=figures, seed=seed, quiet=quiet) as out:
        if method == "hmm" and (force_threshold, velocity_threshold) != (0.05, 0.05):
            where = "--force-threshold, --velocity-threshold"
            raise InputError(where, "go only with the paper's thresholds", "--method qualitative")
        apart = workers is not None or scheduler is not None
        recordings: list[Trial] = []
        paths = distinct_trials(recordings_in(trials) if apart else trials)
        check_destination(write, paths)
        task, rig = find_inputs(paths, task, rig)
        description = read_task(task)
        if isinstance(description, SequenceTask):
            if apart:
                raise InputError("--workers, --scheduler", "go with tasks of blocks alone")
            if method == "qualitative":
                raise InputError("--method qualitative", "needs a task of blocks", "--method hmm")
            from hmmseg.sequence.model import load_model
            from hmmseg.sequence.segment import segment_sequence

            recordings = read_trials(out, paths, None if rig is None else read_rig(rig), description)
            learned = None if model is None else load_model(model, description)
            found = segment_sequence(recordings, description, learned)
        else:
            rig = require_rig(rig, paths)
            if model is not None:
                raise InputError(f"--model {model}", "goes only with a plain ordered task")
            if not apart:
                thresholds = None if method == "hmm" else (force_threshold, velocity_threshold)
                recordings, found = _segment_blocks(out, paths, description, rig, thresholds, write is None)
            elif write is not None or figures is not None or method != "hmm":
                raise InputError("--workers, --scheduler", "go with --json alone")
            else:
                found = _segment_apart(out, paths, task, rig, workers, scheduler)
        if figures is not None:
            for trial, segmentation in zip(recordings, found, strict=True):
                segmentation.plot(out.figure(f"{trial.stem}_segments.png"))
        out.print(*([trials_table(found)] if apart else map(spans_table, found)))
        warn_of_misfits(out, found)
        out.warn(*dict.fromkeys(remark for segmentation in found for remark in segmentation.remarks))
        question = most_telling(found)
        if question is not None:
            out.warn("some boundaries could as well be elsewhere; most would be decided by the start of "
                     f"{question.subtask} in {Path(question.trial).name}, given to hmmseg fit --labels"
                     )  # fmt: skip
        if write is not None:
            write_labels(out, write, paths, recordings, found)
        open_ones = {} if question is None else {"question": asdict(question)}
        out.finish({"method": method, "trials": [s.to_json() for s in found]} | open_ones)


def _segment_blocks(
    out: Output, paths: Sequence[Path], task: BlockTask, rig_file: Path,
    thresholds: tuple[float, float] | None, lean: bool,
) -> tuple[list[Trial], list[Segmentation]]:  # fmt: skip
    """Recordings and segmentations, by the paper's `thresholds` or the HMM; long ones from disk if `lean`."""
    from hmmseg.hand.read import is_long
    from hmmseg.hand.signals import task_space
    from hmmseg.segmentation.align import segment
    from hmmseg.segmentation.thresholds import segment_qualitative

    rig = read_rig(rig_file)
    on_disk = task.repeat != 1 and rig.gripper is None and all(map(is_long, paths))
    if on_disk and lean and out.figures is None and thresholds is None:
        return [], _segment_long(out, paths, task, rig)
    recordings = read_trials(out, paths, rig)
    if thresholds is None:
        return recordings, segment(recordings, task, rig)
    return recordings, [segment_qualitative(t, task_space(t, rig), task, *thresholds) for t in recordings]


def _segment_apart(
    out: Output, paths: Sequence[Path], task: Path, rig: Path, workers: int | None, scheduler: str | None
) -> list[Segmentation]:
    """Segment each recording by itself, in other processes."""
    found = []
    with out.progress("segmenting", len(paths)) as advance:
        each = segment_apart(paths, task, rig, workers, scheduler, advance, out.warn)
        for segmentation, warnings, notes in each:
            out.warn(*warnings)
            out.print(*notes)
            found.append(segmentation)
    if not found:
        raise InputError(str(paths[0]), "the process that segmented it was killed, as of all others",
                         "enough memory, or fewer --workers")  # fmt: skip
    return found


def _segment_long(out: Output, paths: Sequence[Path], task: BlockTask, rig: Rig) -> list[Segmentation]:
    """Segment each recording by itself, from disk, after checking its beginning."""
    from hmmseg.hand.read import LongRecording, check
    from hmmseg.segmentation.align import segment_long

    found = []
    for path in paths:
        recording = LongRecording(path, rig)
        out.warn(*check(recording.beginning(), rig))
        found.append(segment_long(recording, task, rig))
    return found


def warn_of_misfits(out: Output, found: Sequence[Segmentation]) -> None:
    """Warn of the subtask at which each misfit fails, in every repetition that does."""
    for segmentation in found:
        failures = segmentation.failures or filter(None, [segmentation.failed])
        out.warn(*(f"{segmentation.file}: {failure}" for failure in failures))


def fit(
    trials: opt.Trials, model: opt.ModelToWrite, task: opt.TaskFound = None, rig: opt.RigFound = None,
    labels: opt.KnownLabels = None, json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Learn emissions and durations of a plain ordered task, with or without labels."""
    with Output("fit", json=json, seed=seed, quiet=quiet) as out:
        check_file("--model", model, suffixes=(".npz",))
        paths = distinct_trials(trials)
        task, rig = find_inputs(paths, task, rig)
        description = read_task(task)
        if not isinstance(description, SequenceTask):
            raise InputError(str(task), "a task of blocks needs no fitting: its emissions are physics",
                             "a task with `sequence`")  # fmt: skip
        from hmmseg.sequence.fit import fit_sequence, label_files
        from hmmseg.sequence.model import save_model
        from hmmseg.sequence.segment import SURE

        recordings = read_trials(out, paths, None if rig is None else read_rig(rig), description)
        known = {} if labels is None else label_files(labels, recordings)
        learned = fit_sequence(recordings, description, known)
        save_model(learned, out.stage(model))
        out.print(f"learned {len(description.sequence)} states from {len(recordings)} trials, {len(known)} "
                  f"of them labelled; written to {model}")  # fmt: skip
        begins = zip(description.sequence[1:], learned.sure, strict=False)
        doubtful = [f"{name} ({sure:.2f})" for name, sure in begins if sure < SURE]
        if doubtful:
            out.warn(
                "the trials can be read in several ways; the probability of where these begin: "
                f"{', '.join(doubtful)}; hmmseg segment says where else, and which label would decide"
            )
        out.finish({"model": str(model), "trials": [str(p) for p in paths], "labelled": sorted(known)})
