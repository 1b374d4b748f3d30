"""`hmmseg fit`: learn the emissions and durations of a plain ordered task from trials.

`--labels` gives known boundaries: a folder with NAME.json for some trials, {"boundaries": [times in s, null
where unknown]}, or a CSV or TSV file with the columns trial, subtask and start [s].
"""

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
