"""Diagnose the user folders of a sealed set: one warm process, one JSON a case, resumable.

Sees what a user has and no more: trials, task, rig, actual.toml where there is one. options.json may
name effects that are taken out of the catalogue for this case.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estimation.actual import Actual, read_actual
from experiments.blind_check.rivals import rival_verdicts
from experiments.blind_check.sealing import code_digest
from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial, read_trial
from simgap.gap.diagnose import diagnose

Progress = Callable[[int, int, str], None]


def diagnose_cases(cases: Path, results: Path, progress: Progress | None = None) -> int:
    """Write RESULTS/NAME.json for every case folder that has none yet; number of cases.

    InputError where the results so far are those of other code: one run, one code.
    """
    results.mkdir(parents=True, exist_ok=True)
    _same_code(results / "code.json")
    folders = sorted(p.parent for p in cases.glob("*/task.toml"))
    if not folders:
        raise InputError(str(cases), "holds no case", "folders with rig.toml, task.toml and trials")
    for k, folder in enumerate(folders):
        target = results / f"{folder.name}.json"
        if not target.exists():
            body = diagnose_folder(folder)
            part = target.with_suffix(".part")
            part.write_text(json.dumps(body) + "\n", encoding="utf-8")
            os.replace(part, target)
            if progress is not None:
                progress(k + 1, len(folders), f"{folder.name} {body['seconds']:.0f} s")
    return len(folders)


def _same_code(file: Path) -> None:
    now = code_digest()
    if file.exists() and json.loads(file.read_text(encoding="utf-8"))["sha256"] != now:
        raise InputError(str(file.parent), "holds results of other code", "an empty folder for this code's")
    file.write_text(json.dumps({"sha256": now}) + "\n", encoding="utf-8")


def diagnose_folder(folder: Path) -> dict[str, Any]:
    """The diagnosis of one folder as `hmmseg diagnose` gives it, its rivals' verdicts, and its time [s].

    Where no trial fits its task there is an `error` instead: that counts against the diagnosis.
    """
    start = time.perf_counter()
    try:
        found = diagnose(*_read(folder), excluded=excluded(folder))
    except InputError as error:
        return {"error": str(error), "seconds": time.perf_counter() - start}
    seconds = time.perf_counter() - start
    rivals, gains = rival_verdicts(found, excluded(folder))
    more = {"rivals": rivals, "gains": gains, "seconds": seconds}
    return {**found.body, "warnings": list(found.warnings), **more}


def excluded(folder: Path) -> tuple[str, ...]:
    """Effects that the case takes out of the catalogue."""
    file = folder / "options.json"
    return tuple(json.loads(file.read_text(encoding="utf-8"))["exclude"]) if file.exists() else ()


def oracle(folder: Path, effect: str) -> dict[str, float | None]:
    """What the true effect, taken by force, gains on held-out trials [nats] and shrinks the gap by."""
    nothing: dict[str, float | None] = {"gain": None, "fraction": None}
    try:
        found = diagnose(*_read(folder), forced=effect.split("+"))
    except (InputError, ValueError, IndexError):  # no trial fits its task, or nothing to be fitted
        return nothing
    entry, shrinkage = found.body["effects"].get(effect), found.body["shrinkage"]
    return nothing if entry is None or shrinkage is None else {
        "gain": entry["heldout_score"], "fraction": shrinkage["fraction"]
    }  # fmt: skip


def _read(folder: Path) -> tuple[list[Trial], BlockTask, Rig, Actual | None]:
    """Trials, task, rig and, where measured, properties of a folder."""
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    if not isinstance(task, BlockTask):
        raise InputError(str(folder / "task.toml"), "is a plain ordered task", "objects and moves")
    file = folder / "actual.toml"
    actual = read_actual(file, task.objects) if file.exists() else None
    return [read_trial(f, rig) for f in sorted(folder.glob("trial_*.csv"))], task, rig, actual
