"""The bank of the user's own rig and task, learned once and kept in the user's cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import hmmseg
from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.jaxconfig import cache_folder
from simgap.gap.adapt import fingerprint, rate_of
from simgap.gap.bank import CALIBRATED, FILE, Bank, load_bank, parse_bank
from simgap.gap.calibrate import learned

Progress = Callable[[str], None]


def own_bank(trials: Sequence[Trial], task: BlockTask, rig: Rig, tell: Progress) -> Bank:
    """The bank learned on simulations of this rig and task, at the rate and number of these trials.

    Taken from the cache where it was learned before; otherwise it takes a minute or two. InputError for a
    rig or task that cannot be simulated.
    """
    require_simulable(task, rig)
    rate = rate_of(trials)
    file = _file(task, rig, rate, len(trials))
    # A file that is absent, or that another program spoiled, is learned anew.
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return replace(parse_bank(file.read_text(encoding="utf-8")), source=CALIBRATED)
    hand = rig.model_copy(update={"rate": rate})
    bank = learned(task, hand, len(trials), load_bank().calibration, tell)
    with contextlib.suppress(OSError):  # a cache that cannot be written costs time and nothing else
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_name(f".{file.name}.{os.getpid()}")
        beside.write_text(bank.to_json(), encoding="utf-8")
        os.replace(beside, file)  # nobody reads half a file
    return replace(bank, source=CALIBRATED)


def require_simulable(task: BlockTask, rig: Rig) -> None:
    """InputError unless healthy recordings of this rig and task can be simulated for a bank."""
    if not rig.jointed:
        raise InputError("--calibrate: key fingers", "missing: no bank is learned for a Cartesian hand",
                         "the tables [fingers.1] and [fingers.2]")  # fmt: skip
    for name in ("angle", "velocity", "force"):
        if getattr(rig.noise, name) is None:
            raise InputError(f"--calibrate: key noise.{name}", "missing, so it cannot be simulated",
                             "the standard deviation of one sample")  # fmt: skip
    if task.repeat == "unknown":
        raise InputError("--calibrate: key repeat", 'found "unknown"', "how often the moves are repeated")


def _file(task: BlockTask, rig: Rig, rate: float, trials: int) -> Path:
    """Where the bank is kept: by rig, task, recordings, package version and the package's own bank."""
    parts = fingerprint(task, rig, rate, trials), hmmseg.__version__, FILE.read_text(encoding="utf-8")
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:24]
    return cache_folder() / "banks" / f"{digest}.json"
