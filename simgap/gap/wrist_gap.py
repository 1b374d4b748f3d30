"""What of the gap a sensor in the wrist can show: net forces and where the hand is.

The channels of two fingers are made up from the wrist's (`hmmseg.hand.wrist`): each has half of the force,
both have one height, and velocities are derived from positions. What was made up agrees with itself and is
compared with nothing; effects that act on one finger or between both are not thought of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.trial import Trial
from simgap.effects import catalogue, fitted, forms_of, free_parameters

MADE_UP = ("offset", "shear", "vx", "vy")
GRIP = ("distance", "grip")  # without a grip force what the pads give is read off the opening itself
NOT_COMPARED = (
    "a wrist sensor feels the sum of both fingers: net forces and positions are compared, {absent} are not, "
    "and effects on one finger or inside the grip are not thought of"
)


def of_wrist(trials: Sequence[Trial]) -> bool:
    """Whether these recordings are from a sensor in the wrist."""
    return any(trial.inertia is not None for trial in trials)


def absent(trial: Trial) -> tuple[str, ...]:
    """Channels that a trial has not, though its two made-up fingers do."""
    if trial.inertia is None:
        return ()
    return (*MADE_UP, *GRIP) if "friction" in trial.hidden else MADE_UP


def not_compared(trials: Sequence[Trial]) -> str:
    """One line of what a diagnosis leaves out."""
    missing = dict.fromkeys(name for trial in trials for name in absent(trial))
    return NOT_COMPARED.format(absent=", ".join(missing))


def shown(names: Sequence[str]) -> list[str]:
    """Effects that act on net forces or on where things are.

    Offsets, drift, drag and the tool's own mass are not among them: free motion takes them out
    (`hmmseg.hand.tool`).
    """
    return [n for n in names if fitted()[n].wrist]


def shown_forms(names: Sequence[str]) -> list[str]:
    """Keys of those forms of effects that act on both fingers alike."""
    return [key for n in shown(names) for key in forms_of(n)[:1] if free_parameters(key)]


def check_forced(forced: Sequence[str]) -> None:
    """InputError for an effect that a wrist does not show."""
    known = shown(list(catalogue()))
    for name in forced:
        if name not in known:
            problem = "acts in the grip, on one finger or on what free motion takes out, unseen by a wrist"
            raise InputError(f"effect {name!r}", problem, ", ".join(known))


def as_from_wrist(trial: Trial, like: Trial) -> Trial:
    """A simulated trial of two fingers as a wrist would give it: halves, and what is made up marked."""
    c = dict(trial.channels)
    for axis in "xy":
        half = (c[f"f{axis}1"] + c[f"f{axis}2"]) / 2
        grip = (c["fx1"] - c["fx2"]) / 2 if axis == "x" else 0.0
        c[f"f{axis}1"], c[f"f{axis}2"] = half + grip, half - grip
    middle = (c["y1"] + c["y2"]) / 2
    c["y1"], c["y2"] = middle, middle
    assert like.inertia is not None
    return replace(trial, channels=c, inertia=np.zeros((trial.t.size, 2)), hidden=like.hidden)
