"""What a gripper holds between its closings, and how its load tells a mapping that cannot be.

A hand that is raised with what it holds bears it. Where no hold lifts anything, the columns are read the
other ways that a rig may have it, and the way in which the hand lifts something every time is what to write.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.gripper_signs import counts_closing, exchanged_axes, points_down
from hmmseg.hand.opening import Grip, closings, grip_of
from hmmseg.hand.pose import Pose
from hmmseg.hand.tool import Tool, applied_force, free_tool
from hmmseg.io.gripper import Gripper
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.levels import MOVED, SURE
from hmmseg.robust import robust_sd

ACTIVE = 8.0  # chosen: noise scales above which the wrist feels something
TOGETHER = 5  # chosen: samples within one smoothing window
LEAST = 3  # numerics: samples; of fewer there is no scatter


@dataclass(frozen=True)
class Held:
    """Grips, the load of each (None where the hand goes nowhere) [N], the tool, and what it does to its
    environment, `force` (num_timesteps, 3), in the world's axes [N]; `free` (num_timesteps,): samples
    that are surely no grip's; `lifts`: loads that are not nothing of grips in which the hand is raised [N].
    """

    grips: list[Grip]
    loads: list[float | None]
    tool: Tool
    force: np.ndarray
    free: np.ndarray
    lifts: list[float]


def held_by(trial: Trial, rig: Rig, pose: Pose, opening: np.ndarray, pressing: np.ndarray | float | None
            ) -> Held:  # fmt: skip
    """What closings of the opening (num_timesteps,) [m] hold; `pressing` as `grip_force_of` has it."""
    held = closings(opening)
    free = _surely_free(opening, held)
    tool = free_tool(trial, rig, pose, free)
    force = applied_force(trial, rig, pose, tool)
    active = np.linalg.norm(np.nan_to_num(force), axis=1) > ACTIVE * tool.noise
    each = [grip_of(trial.t, opening, active, c, give_of(rig, pressing, opening, c)) for c in held]
    grips = [grip for grip in each if grip is not None]
    loads = [_load(grip, pose, force, tool) for grip in grips]
    lifts = [load for grip, load in zip(grips, loads, strict=True) if load and _is_raised(grip, pose)]
    return Held(grips, loads, tool, force, free, lifts)


def contradiction(trial: Trial, rig: Rig, pose: Pose, opening: np.ndarray, held: Held) -> InputError | None:
    """What to write where no grip lifts anything, None where no other reading explains it, as of slides.

    An opening of the other sign makes free motion of what was held and is told by how much better the tool's
    own share is then found; axes that are exchanged or reversed leave that as it is.
    """
    try:
        flipped = held_by(trial, rig, pose, -opening, None)
    except InputError:
        flipped = None
    if flipped is not None and _lifts_all(flipped.loads) and flipped.tool.noise < held.tool.noise:
        return counts_closing(trial, rig)
    others = [(replace(pose, up=-pose.up), points_down),
              (replace(pose, up=pose.across, across=pose.up), exchanged_axes)]  # fmt: skip
    borne = [[_load(grip, other, held.force, held.tool) for grip in held.grips
              if _is_raised(grip, other)] for other, _ in others]  # fmt: skip
    least = [min(load for load in loads if load) if _lifts_all(loads) else 0.0 for loads in borne]
    best = int(np.argmax(least))
    return others[best][1](trial, rig) if least[best] > 0 else None


def _lifts_all(loads: list[float | None]) -> bool:
    """Whether every grip that goes anywhere bears something, and there is one."""
    there = [load for load in loads if load is not None]
    return bool(there) and min(there) > 0


def _surely_free(opening: np.ndarray, held: list[tuple[int, int, int]]) -> np.ndarray:
    """Samples outside of everything that may be a grip: more open than halfway back."""
    free = np.ones(opening.size, bool)
    for begun, least, opened in held:
        top = min(opening[begun], opening[opened]) if opened > least else opening[begun]
        inside = np.arange(begun, opened + 1)
        free[inside[opening[inside] < opening[least] + 0.5 * (top - opening[least])]] = False
    return free


def grip_force_of(trial: Trial, gripper: Gripper) -> np.ndarray | float | None:
    """What each pad presses with [N]: samples, or a number while it grips; None where nothing tells."""
    if isinstance(gripper.grip_force, str):
        return np.abs(trial.channels[gripper.grip_force])
    if gripper.grip_force is not None:
        return float(gripper.grip_force)
    if gripper.motor_current is not None and gripper.force_per_ampere is not None:
        return np.abs(trial.channels[gripper.motor_current]) * gripper.force_per_ampere
    return None


def give_of(rig: Rig, pressing: np.ndarray | float | None, opening: np.ndarray, closing: tuple[int, int, int]
            ) -> float | None:  # fmt: skip
    """What both pads give while held [m]; None where the force is not known."""
    if pressing is None:
        return None
    if not isinstance(pressing, np.ndarray):
        force = pressing
    else:
        begun, least, opened = closing
        inside = slice(begun, opened + 1)
        low = opening[inside] <= opening[least] + 0.1 * (opening[begun] - opening[least])
        force = float(np.nanmedian(pressing[inside][low]))
    return 2 * force / rig.fingertip.normal_stiffness if np.isfinite(force) else None


def _raised(grip: Grip, pose: Pose) -> np.ndarray:
    """Samples of a grip (num_samples,) in which the hand is higher than where it begins and ends."""
    height = pose.position[grip.start : grip.stop] @ pose.up
    return height - max(height[0], height[-1]) > MOVED


def _is_raised(grip: Grip, pose: Pose) -> bool:
    return bool(_raised(grip, pose).sum() > LEAST)


def _load(grip: Grip, pose: Pose, force: np.ndarray, tool: Tool) -> float | None:
    """What the hand carries while raised, or pushes while it moves along [N]: 0 where it is nothing.

    None where it never goes anywhere, which leaves nothing to judge by.
    """
    inside = slice(grip.start, grip.stop)
    raised = _raised(grip, pose)
    lifted = _is_raised(grip, pose)
    far = np.linalg.norm(pose.position[inside] - pose.position[grip.start], axis=1) > MOVED
    moved = raised if lifted else far
    load = force[inside][moved] @ (pose.up if lifted else pose.across)
    load = load[np.isfinite(load)]
    if load.size <= LEAST:
        return None
    scatter = max(robust_sd(load - np.median(load)), tool.noise)
    found = float(np.median(load))
    if abs(found) <= SURE * scatter / np.sqrt(load.size / TOGETHER):
        return 0.0
    return found if lifted else abs(found)
