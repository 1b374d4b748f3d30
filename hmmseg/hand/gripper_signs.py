"""What a gripper with a wrist sensor cannot do: reach too far, or lift less than nothing."""

from __future__ import annotations

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.pose import bridged
from hmmseg.io.plausibility import REACH, Finding, all_changed, changed
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial

WIDEST = 1.0  # limit: m; no parallel gripper opens further
NARROW = 2e-4  # limit: m


def check_gripper(trial: Trial, rig: Rig) -> list[Finding]:
    """Positions and openings in mm or cm; an opening that does not change."""
    gripper = rig.gripper
    assert gripper is not None
    travels = {name: _travel(trial, name) for name in gripper.position.values()}
    far = {name: travel for name, travel in travels.items() if travel > REACH}
    if far:
        name, travel = max(far.items(), key=lambda item: item[1])
        unit = "cm" if travel < 30 else "mm" if travel < 5e3 else "um"
        problem = f"travels {travel:.4g} m, a hand less than {REACH:g} m: it looks like {unit}"
        return [Finding(name, problem, all_changed(travels, rig, unit=unit))]
    for name in gripper.opening:
        values = trial.channels[name]
        widest, swing = float(np.nanmax(np.abs(values))), _travel(trial, name)
        if swing > WIDEST:
            unit = "cm" if swing < 15 else "mm"
            problem = f"swings by {swing:.4g} m, a gripper by less than {WIDEST:g} m: it looks like {unit}"
            return [Finding(name, problem, changed(name, rig, unit=unit))]
        if swing < NARROW:
            problem = f"changes by {swing:.2g} m in all (of {widest:.3g} m)"
            raise InputError(f"{trial.file}: column {name}", problem, "a gripper that closes and opens, in m")
    return []


def _travel(trial: Trial, name: str) -> float:
    return float(np.nanmax(trial.channels[name]) - np.nanmin(trial.channels[name]))


def counts_closing(trial: Trial, rig: Rig) -> InputError:
    """The line for an opening that grows as the gripper closes."""
    gripper = rig.gripper
    assert gripper is not None
    most = float(sum(bridged(trial.t, trial.channels[name]).max() for name in gripper.opening))
    name = gripper.opening[0]
    fields = changed(name, rig, sign=-1, offset=round(most, 4))
    finding = Finding(name, "", fields)
    problem = "is widest while the hand carries something: it counts how far the gripper has closed"
    return InputError(f"{trial.file}: column {name}", problem, finding.remedy)


def lifts_pull(trial: Trial, rig: Rig, load: float) -> InputError:
    """The line for lifts that take weight [N] off the hand."""
    gripper = rig.gripper
    assert gripper is not None
    where = f"{trial.file}: columns {', '.join(gripper.wrench[:3])}"
    problem = f"say that what is lifted pulls up with {abs(load):.3g} N: the sign is the other way round"
    said = not gripper.reaction if gripper.reaction is not None else True
    return InputError(where, problem, f"reaction = {str(said).lower()} under [gripper]")
