"""`hmmseg fit`: learn the emissions and durations of a plain ordered task from trials."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer

from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask, read_task
from hmmseg_cli.console import (
    JsonOption,
    Output,
    QuietOption,
    SeedOption,
    TaskOption,
    TrialsArgument,
    check_file,
    distinct_trials,
    read_trials,
)

LabelsOption = Annotated[Path | None, typer.Option(
    "--labels", metavar="DIR", help="Folder with NAME.json for some or all trials.")]  # fmt: skip
ModelOption = Annotated[Path, typer.Option("--model", metavar="M.npz", help="Where the model is written.")]
RigFile = Annotated[Path | None, typer.Option(
    "--rig", metavar="R", help="Its [columns] or [topics], if the trials need them.")]  # fmt: skip


def fit(
    trials: TrialsArgument, task: TaskOption, model: ModelOption, rig: RigFile = None,
    labels: LabelsOption = None, json: JsonOption = None, seed: SeedOption = 0, quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Learn emissions and durations of a plain ordered task, with or without labels."""
    with Output("fit", json=json, seed=seed, quiet=quiet) as out:
        check_file("--model", model, suffixes=(".npz",))
        paths = distinct_trials(trials)
        description = read_task(task)
        if not isinstance(description, SequenceTask):
            raise InputError(str(task), "a task of blocks needs no fitting: its emissions are physics",
                             "a task with `sequence`")  # fmt: skip
        from hmmseg.sequence.fit import fit_sequence
        from hmmseg.sequence.model import save_model

        hand = None
        if rig is not None:
            from hmmseg.io.rig import read_rig

            hand = read_rig(rig)
        recordings = read_trials(out, paths, hand, description)
        names = [trial.name for trial in recordings]
        known = {} if labels is None else read_label_folder(labels, names)
        learned = fit_sequence(recordings, description, known, seed)
        save_model(learned, out.stage(model))
        out.print(f"learned {len(description.sequence)} states from {len(recordings)} trials, {len(known)} "
                  f"of them labelled; written to {model}")  # fmt: skip
        out.finish({"model": str(model), "trials": [str(p) for p in paths], "labelled": sorted(known)})


def read_label_folder(folder: Path, names: list[str]) -> dict[str, list[float]]:
    """Boundaries [s] of the trials that have a NAME.json in the folder; InputError for what is amiss."""
    if not folder.is_dir():
        raise InputError(f"--labels {folder}", "no such folder", "a folder with NAME.json for trials")
    paths = {name: folder / f"{Path(name).stem}.json" for name in names}
    out = {name: _boundaries(path) for name, path in paths.items() if path.exists()}
    if not out:
        expected = ", ".join(path.name for path in list(paths.values())[:3])
        raise InputError(f"--labels {folder}", "has labels for none of the trials", f"files like {expected}")
    return out


def _boundaries(path: Path) -> list[float]:
    try:
        return [float(b) for b in jsonlib.loads(path.read_text(encoding="utf-8"))["boundaries"]]
    except (OSError, ValueError, TypeError, KeyError):
        raise InputError(str(path), "cannot be read", '{"boundaries": [times in s]}') from None
