"""What a gripper with a wrist sensor cannot do: reach too far, or lift less than nothing."""

from __future__ import annotations

import json
import re

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.gripper import AXES
from hmmseg.io.plausibility import REACH, Finding, all_changed, changed, length_unit
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.robust import bridged

WIDEST = 1.0  # limit: m; no parallel gripper opens further
NARROW = 2e-4  # limit: m
CANCELLED = 0.05  # limit: share of either finger's way


def check_gripper(trial: Trial, rig: Rig) -> list[Finding]:
    """Positions and openings in other units; an opening that does not change, or is one finger's."""
    gripper = rig.gripper
    assert gripper is not None
    travels = {name: _travel(trial, name) for name in gripper.position.values()}
    far = {name: travel for name, travel in travels.items() if travel > REACH}
    if far:
        name, travel = max(far.items(), key=lambda item: item[1])
        unit, text = length_unit(travel)
        problem = f"travels {travel:.4g} m, a hand less than {REACH:g} m: it looks like {text}"
        return [Finding(name, problem, all_changed(travels, rig, unit=unit))]
    for name in gripper.opening:
        values = trial.channels[name]
        widest, swing = float(np.nanmax(np.abs(values))), _travel(trial, name)
        if swing > WIDEST:
            unit, text = ("cm", 'cm (or "in")') if swing < 15 else ("mm", "mm (or %)")
            problem = f"swings by {swing:.4g} m, a gripper by less than {WIDEST:g} m: it looks like {text}"
            return [Finding(name, problem, changed(name, rig, unit=unit))]
        if swing < NARROW:
            problem = f"changes by {swing:.2g} m in all (of {widest:.3g} m)"
            raise InputError(f"{trial.file}: column {name}", problem, "a gripper that closes and opens, in m")
    return _cancelling(trial, rig) or _one_finger(rig)


def _cancelling(trial: Trial, rig: Rig) -> list[Finding]:
    """Two fingers' ways of which one counts the other way: their sum stays while they move."""
    gripper = rig.gripper
    assert gripper is not None
    if len(gripper.opening) < 2:
        return []
    first, second = (trial.channels[name] for name in gripper.opening)
    swings = [_travel(trial, name) for name in gripper.opening]
    total = first + second
    if not np.isfinite(total).any() or np.nanmax(total) - np.nanmin(total) > CANCELLED * min(swings):
        return []
    name = gripper.opening[int(np.nanmedian(second) < np.nanmedian(first))]
    problem = f"moves while {' + '.join(gripper.opening)} stays as it is: it counts the other way"
    return [Finding(name, problem, changed(name, rig, sign=-1))]


def _one_finger(rig: Rig) -> list[Finding]:
    """An opening of one column that is named after one of two fingers."""
    gripper = rig.gripper
    assert gripper is not None
    (name, *more) = gripper.opening
    entry = (rig.columns | rig.topics).get(name)
    if more or (entry is not None and entry.unit is not None):
        return []
    if re.search(r"finger.*(\d|left|right)|(left|right).*finger", name.lower()) is None:
        return []
    problem = "is named after one finger, and would show half of the opening: widths halved"
    return [Finding(name, problem, changed(name, rig, unit=2.0), certain=False)]


def _travel(trial: Trial, name: str) -> float:
    return float(np.nanmax(trial.channels[name]) - np.nanmin(trial.channels[name]))


def counts_closing(trial: Trial, rig: Rig) -> InputError:
    """The line for an opening that grows as the gripper closes."""
    gripper = rig.gripper
    assert gripper is not None
    most = float(sum(bridged(trial.channels[name], trial.t).max() for name in gripper.opening))
    name = gripper.opening[0]
    fields = changed(name, rig, sign=-1, offset=round(most, 4))
    finding = Finding(name, "", fields)
    problem = "is widest while the hand carries something: it counts how far the gripper has closed"
    return InputError(f"{trial.file}: column {name}", problem, finding.remedy)


def lifts_pull(trial: Trial, rig: Rig, load: float) -> InputError:
    """The line for lifts that take weight [N] off the hand, whichever sign is stated."""
    problem = f"say that what is lifted pulls up with {abs(load):.3g} N: the sign is the other way round"
    return _other_sign(trial, rig, problem)


def goes_against(trial: Trial, rig: Rig) -> InputError:
    """The line for a stated sign that free motion contradicts, where nothing is lifted that would tell."""
    problem = "go against the hand's own acceleration in free motion: the sign is the other way round"
    return _other_sign(trial, rig, problem)


def borne_out(trial: Trial, rig: Rig, load: float) -> str:
    """The warning where a lift tells one sign and free motion the other: readings that go with the pose."""
    gripper = rig.gripper
    assert gripper is not None
    where = f"{trial.file}: columns {', '.join(gripper.wrench[:3])}"
    return (
        f"{where} bear {load:.3g} N of what is lifted, but go against the hand's own acceleration in free "
        "motion: they change with the pose, and loads are wrong by as much"
    )


def _other_sign(trial: Trial, rig: Rig, problem: str) -> InputError:
    gripper = rig.gripper
    assert gripper is not None
    where = f"{trial.file}: columns {', '.join(gripper.wrench[:3])}"
    said = not gripper.reaction if gripper.reaction is not None else True
    return InputError(where, problem, f"reaction = {str(said).lower()} under [gripper]")


def points_down(trial: Trial, rig: Rig) -> InputError:
    """The line for an axis that counts downwards: what is lifted would go down."""
    gripper = rig.gripper
    assert gripper is not None
    axis = gripper.up.lstrip("-")
    said = axis if gripper.up.startswith("-") else f"-{axis}"
    name = {str(each): name for each, name in gripper.position.items()}[axis]
    where = f"{trial.file}: column {name}"
    return InputError(where, "goes down whenever the hand bears something, as if it counted downwards",
                      f'up = "{said}" under [gripper]')  # fmt: skip


def exchanged_axes(trial: Trial, rig: Rig) -> InputError:
    """The line for position columns of the wrong axes: what is carried would pull sideways."""
    gripper = rig.gripper
    assert gripper is not None
    up, position = gripper.up.lstrip("-"), {str(axis): name for axis, name in gripper.position.items()}
    others = [axis for axis in AXES if axis != up and axis in position]
    across = gripper.closing if gripper.closing in others else others[0]
    swapped = position | {up: position[across], across: position[up]}
    text = ", ".join(f"{axis} = {json.dumps(swapped[axis])}" for axis in AXES if axis in swapped)
    where = f"{trial.file}: columns {position[up]}, {position[across]}"
    problem = f"say that the hand's load pulls along {across} and never along {up}: axes exchanged"
    return InputError(where, problem, f"position = {{{text}}} under [gripper]")
