"""Recordings as they are read: from any source, mapped, judged, and as the two fingers that a hand has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.hand.plausibility import (
    Finding,
    check_angles,
    check_axes,
    check_clock,
    check_forces,
    check_lengths,
    check_signs,
    check_velocities,
    judged,
)
from hmmseg.hand.roll import levelled
from hmmseg.hand.sensing import SPARSE, check_noise, sensed
from hmmseg.hand.wrist import check_gripper, from_halves, halved, two_fingers
from hmmseg.io.formats import LOGS, kind_of, read_table, split_part
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.table import frame_table
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial, channels_of, trial_of
from hmmseg.io.units import Column, source_of


def read_trial(source: str | Path | Any, rig: Rig | None = None, task: SequenceTask | None = None) -> Trial:
    """A recording, read and checked.

    The channels kept are the rig's (joint space, Cartesian or a gripper's), or for a plain ordered
    task the ones it names (every column but `t` otherwise), taken from the columns or messages
    that the rig's `[columns]` or `[topics]` map to them.

    Args:
        source: a file, a pandas or polars DataFrame, or a dict of arrays.
        rig: the hand; a plain ordered task needs none.
        task: a plain ordered task; none for a task of blocks.

    Returns:
        The trial, in SI units.

    Raises:
        InputError: a file cannot be read, or a hand's recording cannot be as it is (other units, flipped
            signs, swapped fingers); it says where, and what to write into the rig.
        ValueError: neither a rig nor a task is given.
    """
    if task is None and rig is None:
        raise ValueError("a block task's trial needs its rig")
    names, _ = channels_of(rig, task)
    log = isinstance(source, str | Path) and kind_of(split_part(source)[0]) in LOGS
    columns: Mapping[str, Column] = {} if rig is None else (rig.topics if log else rig.columns)
    theirs = None if names is None else [source_of(name, columns) for name in ("t", *names)]
    read = read_table if isinstance(source, str | Path) else frame_table
    table = read(source, theirs)
    trial = trial_of(table, rig, task)
    if task is not None or rig is None:
        warnings = judged(trial, check_clock(trial, rig, moving=False))
        return replace(trial, warnings=(*trial.warnings, *warnings))
    trial = sensed(trial, rig)
    warnings = check(trial, rig)
    trial = levelled(trial)
    if rig.gripper is not None:
        trial = two_fingers(trial, rig)
    elif halved(trial):
        trial = from_halves(trial, rig)
    return replace(trial, warnings=(*trial.warnings, *warnings))


def findings(trial: Trial, rig: Rig) -> list[Finding]:
    """What is amiss with a trial, up to and with the first thing that cannot be.

    Units come first: what moves 120 m has no sides.
    """
    out: list[Finding] = []
    looks = [check_clock, check_lengths, check_angles, check_velocities, check_forces]
    if not halved(trial):  # a wrist's force has no sides
        looks += [check_noise, check_axes, check_signs] if _felt(trial) else [check_noise]
    if rig.gripper is not None:
        looks = [check_clock, check_gripper]
    for look in looks:
        for finding in look(trial, rig):
            mapped = "topics" if any(name in rig.topics for name in finding.changes) else "columns"
            out.append(replace(finding, table=mapped))
            if finding.certain:
                return out
    return out


def _felt(trial: Trial) -> bool:
    """Whether forces are there often enough to judge sides and signs by."""
    forces = [trial.channels[name] for name in FORCE_CHANNELS if name in trial.channels]
    return all(np.mean(np.isnan(force)) < SPARSE for force in forces)


def check(trial: Trial, rig: Rig) -> tuple[str, ...]:
    """Warnings about a trial; InputError for what cannot be."""
    return judged(trial, findings(trial, rig))
