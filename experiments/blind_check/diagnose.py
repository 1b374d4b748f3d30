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

import numpy as np

from estimation.report import Actual, read_actual
from experiments.blind_check.sealing import code_digest
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.attribution.posterior import fitted, forms
from simgap.effects import name_of
from simgap.gap.diagnose import Diagnosis, diagnose

Progress = Callable[[int, int, str], None]


def diagnose_cases(
    cases: Path, results: Path, progress: Progress | None = None, seconds: float = float("inf")
) -> int:
    """Write RESULTS/NAME.json for every case folder that has none yet, in order; number of cases.

    No case is begun after so many `seconds`. InputError where the results so far are those of other code:
    one run, one code.
    """
    results.mkdir(parents=True, exist_ok=True)
    _same_code(results / "code.json")
    folders = sorted(p.parent for p in cases.glob("*/task.toml"))
    if not folders:
        raise InputError(str(cases), "holds no case", "folders with rig.toml, task.toml and trials")
    begun = time.monotonic()
    for k, folder in enumerate(folders):
        target = results / f"{folder.name}.json"
        if time.monotonic() - begun > seconds:
            return k
        if not target.exists():
            body = diagnose_folder(folder)
            part = target.with_suffix(".part")
            part.write_text(json.dumps(body) + "\n", encoding="utf-8")
            os.replace(part, target)
            if progress is not None:
                progress(k + 1, len(folders), f"{folder.name} {body['seconds']:.1f} s")
    return len(folders)


def _same_code(file: Path) -> None:
    now = code_digest()
    if file.exists() and json.loads(file.read_text(encoding="utf-8"))["sha256"] != now:
        raise InputError(str(file.parent), "holds results of other code", "an empty folder for this code's")
    file.write_text(json.dumps({"sha256": now}) + "\n", encoding="utf-8")


def diagnose_folder(folder: Path) -> dict[str, Any]:
    """The diagnosis of one folder as `hmmseg diagnose` gives it with its default flags, its CPU time [s], the
    gain of every single effect [nats] and the verdict of BIC over them.

    A case that ends in an error has `error` instead: that counts against the diagnosis.
    """
    start = time.process_time()
    try:
        found = diagnose(*read_folder(folder), excluded=excluded(folder))
    except Exception as error:  # whatever it is, the user has no diagnosis
        return {"error": f"{type(error).__name__}: {error}", "seconds": time.process_time() - start}
    seconds = time.process_time() - start
    more = {"gains": _gains(found), "bic": _bic(found), "seconds": seconds}
    return {**found.body, "warnings": list(found.warnings), **more}


def excluded(folder: Path) -> tuple[str, ...]:
    """Effects removed from the catalogue for this case."""
    file = folder / "options.json"
    return tuple(json.loads(file.read_text(encoding="utf-8"))["exclude"]) if file.exists() else ()


def _gains(found: Diagnosis) -> dict[str, float]:
    """Gain of each single effect [nats], a nat per parameter paid (Akaike); a scatter's log Bayes factor."""
    healthy, f, fits = found.search.healthy, forms(found.search.gap), found.search.fits
    paid = healthy.cost + len(healthy.columns)
    every = [(name_of(one.effects[0]), float(paid - one.cost - len(one.columns))) for one in fits]
    others, none = enumerate(f.gap.candidates[len(fits) :], len(fits)), fitted(f, ()).score + f.log_odds
    every += [(c.name, float(fitted(f, (j,)).score - none)) for j, c in others]
    return {name: max(v for n, v in every if n == name) for name, gain in every if np.isfinite(gain)}


def _bic(found: Diagnosis) -> str:
    """The simplest rival: least sum of squares + parameters x log(number of residuals), or none."""
    healthy = found.search.healthy
    n = healthy.residual.size
    score = {"none": float(healthy.residual @ healthy.residual)}
    for f in found.search.fits:
        more, name = len(f.columns) - len(healthy.columns), name_of(f.effects[0])
        value = float(f.residual @ f.residual) + more * np.log(n)
        score[name] = min(score.get(name, np.inf), value)
    return min(score, key=lambda k: score[k])


def read_folder(folder: Path) -> tuple[AlignedTrials, Actual | None]:
    """Aligned trials and, where measured, properties of a folder."""
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    if not isinstance(task, BlockTask):
        raise InputError(str(folder / "task.toml"), "is a plain ordered task", "objects and moves")
    file = folder / "actual.toml"
    actual = read_actual(file, task.objects) if file.exists() else None
    trials = [read_trial(f, rig) for f in sorted(folder.glob("trial_*.csv"))]
    return align(trials, task, rig), actual
