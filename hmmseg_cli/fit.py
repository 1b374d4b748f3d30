"""`hmmseg fit`: learn the emissions and durations of a plain ordered task from trials.

`--labels` gives known boundaries: a folder with NAME.json for some trials, {"boundaries": [times in s, null
where unknown]}, or a CSV file with the columns trial, subtask and start [s].
"""

from __future__ import annotations

import csv
import json as jsonlib
from pathlib import Path
from typing import Any

from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.task import SequenceTask, read_task
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_file, distinct_trials, find_inputs, read_trials


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
        from hmmseg.sequence.fit import fit_sequence
        from hmmseg.sequence.model import save_model
        from hmmseg.sequence.segment import SURE

        recordings = read_trials(out, paths, None if rig is None else read_rig(rig), description)
        names = [trial.name for trial in recordings]
        known = {} if labels is None else read_labels_given(labels, names)
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


COLUMNS = ("trial", "subtask", "start")


def read_labels_given(where: Path, names: list[str]) -> dict[str, Any]:
    """Read labels of trials.

    Args:
        where: a folder with NAME.json, or a CSV file.
        names: of the trials.

    Returns:
        Labels as `hmmseg.sequence.fit` takes them, by trial; unlabelled trials are left out.

    Raises:
        InputError: there are no labels, they cannot be read, or belong to none of the trials.
    """
    stems = {Path(name).stem: name for name in names}
    if where.is_dir():
        files = {name: where / f"{stem}.json" for stem, name in stems.items()}
        out = {name: _boundaries(path) for name, path in files.items() if path.exists()}
        if not out:
            few = ", ".join(path.name for path in [*files.values()][:3])
            raise InputError(f"--labels {where}", "has labels for none of the trials", f"files like {few}")
        return out
    if not where.is_file() or where.suffix.lower() != ".csv":
        problem = f"ends in {where.suffix!r}" if where.is_file() else "no such file or folder"
        raise InputError(f"--labels {where}", problem, "a folder or a .csv file")
    found = _csv(where)
    for given in found:
        if Path(given).stem not in stems and given not in stems:
            raise InputError(str(where), f"labels {given!r}, which is none of the trials",
                             f"one of {', '.join(stems)}")  # fmt: skip
    return {stems.get(given) or stems[Path(given).stem]: known for given, known in found.items()}


def _boundaries(path: Path) -> list[float | None]:
    try:
        given = jsonlib.loads(path.read_text(encoding="utf-8"))["boundaries"]
        return [None if each is None else float(each) for each in given]
    except (OSError, ValueError, TypeError, KeyError):
        raise InputError(str(path), "cannot be read", '{"boundaries": [times in s]}') from None


def _csv(path: Path) -> dict[str, dict[str, float]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error):
        raise InputError(str(path), "cannot be read", "a table with trial, subtask, start") from None
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        found = "has no rows" if not rows else f"has no column {missing[0]}"
        raise InputError(str(path), found, "the columns trial, subtask, start")
    out: dict[str, dict[str, float]] = {}
    for number, row in enumerate(rows, 2):
        trial, subtask, start = ((row[name] or "").strip() for name in COLUMNS)
        try:
            time = float(start)
        except ValueError:
            raise InputError(f"{path}, line {number}", f"start {start!r}", "a time in s") from None
        if subtask in out.setdefault(trial, {}):
            raise InputError(f"{path}, line {number}", f"labels {subtask} of {trial} again", "one start each")
        out[trial][subtask] = time
    return out
