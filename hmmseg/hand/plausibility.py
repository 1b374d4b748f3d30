"""Whether a hand's recording can be what it says: refused, or warned of, with the remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.hand.axes import check_axes
from hmmseg.hand.force_units import check_noise
from hmmseg.hand.gripper_signs import check_gripper
from hmmseg.hand.sensing import SPARSE
from hmmseg.hand.signs import check_signs
from hmmseg.hand.wrist import halved
from hmmseg.io.plausibility import (
    Finding,
    check_angles,
    check_clock,
    check_forces,
    check_lengths,
    check_velocities,
    judged,
)
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.trial import Trial


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
