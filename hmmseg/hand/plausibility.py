"""Whether a hand's recording can be what it says: refused, or warned of, with the remedy.

What two fingers cannot do: hold a block from the wrong sides, or carry it with the wrong signs.

Fingers that hold something press towards each other, finger 1 from the left; what is carried up
weighs on them. Forces are what a fingertip exerts on the block, so a grip has fx1 > 0 and
fx2 < 0, and a carry fy1 + fy2 > 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmmseg.hand.sensing import SPARSE, check_noise
from hmmseg.hand.signals import task_space
from hmmseg.hand.wrist import check_gripper, halved
from hmmseg.io.plausibility import (
    Finding,
    all_changed,
    changed,
    check_angles,
    check_clock,
    check_forces,
    check_lengths,
    check_velocities,
    exchanged,
    judged,
)
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.trial import Trial
from hmmseg.robust import white_sd

MORE = 3.0  # limit: a grip is so many times what pads share of a load unequally
CARTESIAN = ("{}1", "{}2", "v{}1", "v{}2")
FORCES = ("f{}1", "f{}2")


def check_axes(trial: Trial, rig: Rig) -> list[Finding]:
    """Fingers that press against each other, or stand apart, along y in place of x."""
    s = task_space(trial, rig)
    pressed = _strong(np.fmax(np.abs(s.fx1), np.abs(s.fx2))), _strong(s.fy1 - s.fy2)  # whatever signs of fx
    noise = max(_noise(s.fy1), _noise(s.fy2))
    forces = bool(pressed[1] > max(MORE * pressed[0], 20 * noise))
    gripping = np.abs(s.fy1 - s.fy2 if forces else s.fx1) > pressed[forces] / 2
    places = False
    if not rig.jointed and gripping.any():
        apart = [abs(float(np.nanmedian(v[gripping]))) if np.isfinite(v[gripping]).any() else 0.0
                 for v in (s.x2 - s.x1, s.y2 - s.y1)]  # fmt: skip
        places = bool(apart[1] > MORE * apart[0])
    if not forces and not places:
        return []
    stems = (*(CARTESIAN if places else ()), *(FORCES if forces else ()))
    text = " and ".join(["press against each other"] * forces + ["stand apart in a grip"] * places)
    problem = f"and y are exchanged: the fingers {text} along y"
    first = "fx1" if forces and not places else "x1"
    return [Finding(first, problem, exchanged(stems, ("x", "y"), trial, rig))]


def _strong(difference: np.ndarray) -> float:
    """What a grip makes of a difference of forces (num_timesteps,) [N]."""
    there = np.abs(difference[np.isfinite(difference)])
    return float(np.quantile(there, 0.95)) if there.size else 0.0


def _noise(values: np.ndarray) -> float:
    there = values[np.isfinite(values)]
    return white_sd(there, 1) if there.size > 1 else 0.0


ALL = 0.95  # limit: share of the samples that must agree
MOST = 0.75  # limit: the same where a hold goes on after its block has been put down
LIFTED = 0.005  # limit: [m]
CARTESIAN_STEMS = ("x{}", "y{}", "vx{}", "vy{}", "fx{}", "fy{}")
JOINT_STEMS = ("q{}1", "q{}2", "dq{}1", "dq{}2", "fx{}", "fy{}")
BRIEF = 5  # limit: samples: a shorter touch holds nothing


@dataclass(frozen=True)
class Holds:
    """Samples (num_timesteps,) in which the fingers press, how high the hand is above each hold's
    first sample [m], and which samples come before the first touch; whether each hold that moves
    the hand goes up first.
    """

    pressed: np.ndarray
    height: np.ndarray
    before: np.ndarray
    rises: tuple[bool, ...]


def check_signs(trial: Trial, rig: Rig) -> list[Finding]:
    """Swapped fingers, flipped signs, and weight that is not the block's."""
    signals = task_space(trial, rig)
    squeeze, common = (signals.fx1 - signals.fx2) / 2, (signals.fx1 + signals.fx2) / 2
    there = (
        np.isfinite(squeeze)
        & np.isfinite(signals.distance)
        & np.isfinite(signals.y)
        & np.isfinite(signals.fy)
    )
    if there.sum() < 4 * BRIEF:
        return []
    load = signals.fy[there]
    same = _pushing_alike(common[there], squeeze[there], load)
    if same is not None:
        finger = 2 if same > 0 else 1
        problem = "fx1 and fx2 push the same way all along, a grip pushes from both sides"
        return [Finding(f"fx{finger}", problem, changed(f"fx{finger}", rig, sign=-1))]
    holds = find_holds(squeeze[there], signals.y[there])
    if holds is None:
        return []
    apart = _agreed(signals.distance[there][holds.pressed])
    towards = _agreed(squeeze[there][holds.pressed])
    lifts = holds.pressed & (holds.height > LIFTED)
    idle = float(np.median(load[holds.before])) if holds.before.sum() >= BRIEF else 0.0
    carried = _agreed(load[lifts] - idle, MOST) if lifts.sum() >= BRIEF else 0
    bearing = signals.fy1[there][lifts], signals.fy2[there][lifts]
    first, second = (float(np.median(f)) if f.size >= BRIEF else 0.0 for f in bearing)
    found = _sides(apart, towards, carried, first * second > 0, trial, rig)
    found = found or _one_bears(first, second, idle, rig)
    found = found or _downwards(holds, load, trial, rig)
    if found or lifts.sum() < BRIEF:
        return found
    grip = float(np.median(np.abs(squeeze[there][holds.pressed])))
    return _own_weight(idle, float(np.median(load[lifts])) - idle, grip, rig)


def _sides(apart: int, towards: int, carried: int, both_bear: bool, trial: Trial, rig: Rig) -> list[Finding]:
    """From the signs of x2 - x1 and fx1 - fx2 in a hold and of the load in a lift (0: unclear).

    `both_bear` says whether fy1 and fy2 have the same sign in a lift.
    """
    if apart < 0 and towards < 0:
        problem = "finger 1 holds from the right, finger 2 from the left: the fingers are swapped"
        stems = JOINT_STEMS if rig.jointed else CARTESIAN_STEMS
        return [Finding("x1", problem, exchanged(stems, ("1", "2"), trial, rig))]
    if apart > 0 and towards < 0:
        if carried < 0:
            problem = "is negative in a grip and fy1 + fy2 in a lift: forces on the finger, not by it"
            changes = all_changed(FORCE_CHANNELS, rig, sign=-1)
        else:
            problem = "is negative and fx2 positive in a grip: their signs are flipped"
            changes = all_changed(("fx1", "fx2"), rig, sign=-1)
        return [Finding("fx1", problem, changes)]
    if apart < 0 and towards > 0 and not rig.jointed:
        problem = "is right of x2 in a grip, but fx1 pushes to the right: positions swapped or x flipped"
        moved = [name for name in ("x1", "vx1", "x2", "vx2") if name in trial.channels]
        changes = all_changed(moved, rig, sign=-1)
        return [Finding("x1", problem, changes)]
    if apart > 0 and towards > 0 and carried < 0 and both_bear:
        problem = "and fy2 are negative in sum while a block is lifted: their signs are flipped"
        return [Finding("fy1", problem, all_changed(("fy1", "fy2"), rig, sign=-1))]
    return []


def _one_bears(first: float, second: float, idle: float, rig: Rig) -> list[Finding]:
    """A finger [N] that pulls down in lifts as strongly as the other bears: one sign is flipped."""
    if first * second >= 0 or abs(first + second - idle) > 0.2 * abs(first - second):
        return []
    name = "fy1" if first < 0 else "fy2"
    problem = f"pulls down with {abs(min(first, second)):.3g} N in lifts while the other finger bears as much"
    return [Finding(name, problem, changed(name, rig, sign=-1), certain=False)]


def _downwards(holds: Holds, load: np.ndarray, trial: Trial, rig: Rig) -> list[Finding]:
    """Holds that all go down first, through what the block stands on: y points down."""
    if any(holds.rises) or not holds.rises or rig.jointed:
        return []
    low = holds.pressed & (holds.height < -LIFTED)
    axes = ["y1", "y2"] if float(np.median(load[low])) > 0 else ["y1", "y2", "fy1", "fy2"]
    axes += [name for name in ("vy1", "vy2") if name in trial.channels]
    problem = (
        "every hold first goes down from where it began, through what the block stands on: y points down"
    )
    return [Finding("y1", problem, all_changed(axes, rig, sign=-1), certain=False)]


def _own_weight(idle: float, lifted: float, grip: float, rig: Rig) -> list[Finding]:
    """A load in free motion [N] beside what a lift adds: the hand's own weight, or no zero taken.

    Smaller ones are a bias, which is estimated.
    """
    if abs(idle) < max(abs(lifted), 0.1 * grip):
        return []
    problem = (
        f"and fy2 sum to {idle:.3g} N before the first touch, a lift adds {lifted:.3g} N: gravity or "
        "an offset is still in the forces"
    )
    changes = all_changed(("fy1", "fy2"), rig, offset=round(-idle / 2, 4))
    return [Finding("fy1", problem, changes, certain=False)]


def find_holds(squeeze: np.ndarray, y: np.ndarray) -> Holds | None:
    """Runs of samples with at least half the usual grip; None where nothing is ever held."""
    scale = float(np.quantile(np.abs(squeeze), 0.95))
    noise = white_sd(squeeze, 1)
    if scale == 0 or scale < 10 * noise:
        return None
    pressed = np.abs(squeeze) > scale / 2
    edges = np.flatnonzero(np.diff(np.concatenate([[0], pressed.astype(int), [0]])))
    height, rises = np.zeros(y.size), []
    kept = np.zeros(y.size, dtype=bool)
    for start, end in edges.reshape(-1, 2):
        if end - start >= BRIEF:
            kept[start:end] = True
            height[start:end] = y[start:end] - y[start]
            moved = height[start:end][np.abs(height[start:end]) > LIFTED]
            rises += [bool(moved[0] > 0)] if moved.size else []
    if not kept.any():
        return None
    touched = int(np.flatnonzero(np.abs(squeeze) > scale / 10)[0])
    return Holds(kept, height, np.arange(y.size) < touched, tuple(rises))


def _pushing_alike(common: np.ndarray, squeeze: np.ndarray, load: np.ndarray) -> int | None:
    """Sign of both fx where they push the same way as strongly and as long as a grip would."""
    scale = float(np.quantile(np.abs(common), 0.95))
    noise = white_sd(common, 1)
    strong = np.abs(common) > scale / 2
    if scale < max(10 * noise, 3 * float(np.quantile(np.abs(squeeze), 0.95))):
        return None
    if scale < 0.25 * float(np.quantile(np.abs(load), 0.95)) or not 0.1 < strong.mean() < ALL:
        return None  # too weak to hold, a touch, or no grip that begins and ends
    return _agreed(common[strong]) or None


def _agreed(values: np.ndarray, share: float = ALL) -> int:
    """The sign that so many samples have, 0 where they disagree."""
    positive = float((values > 0).mean())
    return 1 if positive >= share else -1 if positive <= 1 - share else 0


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
