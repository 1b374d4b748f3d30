"""`hmmseg fit`: learn the emissions and durations of a plain ordered task from trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask, read_task
from hmmseg_cli.console import (
    JsonOption,
    Output,
    QuietOption,
    RigBeside,
    TaskBeside,
    TrialsArgument,
    UnusedSeed,
    check_file,
    described,
    distinct_trials,
    read_trials,
)
from hmmseg_cli.known import read_labels_given

LabelsOption = Annotated[Path | None, typer.Option(
    "--labels", metavar="FILE|DIR",
    help="What is known of some boundaries: a folder with NAME.json, or a .csv or .json file.")]  # fmt: skip
ModelOption = Annotated[Path, typer.Option("--model", metavar="M.npz", help="Where the model is written.")]


def fit(
    trials: TrialsArgument, model: ModelOption, task: TaskBeside = None, rig: RigBeside = None,
    labels: LabelsOption = None, json: JsonOption = None, seed: UnusedSeed = 0, quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Learn emissions and durations of a plain ordered task, with or without labels."""
    with Output("fit", json=json, seed=seed, quiet=quiet) as out:
        check_file("--model", model, suffixes=(".npz",))
        paths = distinct_trials(trials)
        task, rig = described(paths, task, rig)
        description = read_task(task)
        if not isinstance(description, SequenceTask):
            raise InputError(str(task), "a task of blocks needs no fitting: its emissions are physics",
                             "a task with `sequence`")  # fmt: skip
        from hmmseg.sequence.fit import fit_sequence
        from hmmseg.sequence.model import save_model
        from hmmseg.sequence.segment import SURE

        hand = None
        if rig is not None:
            from hmmseg.io.rig import read_rig

            hand = read_rig(rig)
        recordings = read_trials(out, paths, hand, description)
        names = [trial.name for trial in recordings]
        known = {} if labels is None else read_labels_given(labels, names)
        learned = fit_sequence(recordings, description, known)
        save_model(learned, out.stage(model))
        out.print(f"learned {len(description.sequence)} states from {len(recordings)} trials, {len(known)} "
                  f"of them labelled; written to {model}")  # fmt: skip
        doubtful = [
            f"{name} ({sure:.2f})"
            for name, sure in zip(description.sequence[1:], learned.sure, strict=False)
            if sure < SURE
        ]
        if doubtful:
            out.warn(
                "the trials can be read in several ways; the probability of where these begin: "
                f"{', '.join(doubtful)}; hmmseg segment says where else, and which label would decide"
            )
        out.finish({"model": str(model), "trials": [str(p) for p in paths], "labelled": sorted(known)})
