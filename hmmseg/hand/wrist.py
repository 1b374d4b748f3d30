"""A gripper with a sensor in its wrist as the two fingers that the contact equations know.

The wrist feels the sum of what both fingers do; each finger's channels hold half of it. What
they press against each other with does not reach the wrist. Where no grip force is recorded, the
pads' own spring gives it: their squeeze is the opening at which they touched (`hmmseg.hand.grips`) less the
one they are held at. That says when something is held, but is no measured force: it does not bound friction.

A hand that is raised with what it holds bears it. Where no hold lifts anything, the columns are read the
other ways that a rig may have it, and the way in which the hand lifts something every time is what to write.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.grips import Grip, closings, free_samples, grip_of
from hmmseg.hand.plausibility import REACH, Finding, all_changed, changed, length_unit
from hmmseg.hand.sensing import tool_warnings
from hmmseg.hand.tool import Pose, Tool, applied_force, free_tool, order_warnings, pose_of, smooth
from hmmseg.io.rig import AXES, Gripper, Rig, direction
from hmmseg.io.trial import ROLL, Trial
from hmmseg.levels import MOVED, SURE
from hmmseg.robust import bridged, robust_sd, runs

WIDEST = 1.0  # limit: m; no parallel gripper opens further
NARROW = 2e-4  # limit: m
CANCELLED = 0.05  # limit: share of either finger's way


def check_gripper(trial: Trial, rig: Rig) -> list[Finding]:
    """Positions and openings in other units; an opening that does not change, or is one finger's."""
    gripper = rig.wrist
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
    names = rig.wrist.opening
    if len(names) < 2:
        return []
    first, second = (trial.channels[name] for name in names)
    total, least = first + second, min(_travel(trial, name) for name in names)
    if not np.isfinite(total).any() or np.nanmax(total) - np.nanmin(total) > CANCELLED * least:
        return []
    name = names[int(np.nanmedian(second) < np.nanmedian(first))]
    problem = f"moves while {' + '.join(names)} stays as it is: it counts the other way"
    return [Finding(name, problem, changed(name, rig, sign=-1))]


def _one_finger(rig: Rig) -> list[Finding]:
    """An opening of one column that is named after one of two fingers."""
    gripper = rig.wrist
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
    gripper = rig.wrist
    most = float(sum(bridged(trial.channels[name], trial.t).max() for name in gripper.opening))
    name = gripper.opening[0]
    remedy = Finding(name, "", changed(name, rig, sign=-1, offset=round(most, 4))).remedy
    problem = "is widest while the hand carries something: it counts how far the gripper has closed"
    return InputError(f"{trial.file}: column {name}", problem, remedy)


def other_sign(trial: Trial, rig: Rig, load: float | None = None) -> InputError:
    """The line for a sign that is the other way round: lifts take weight `load` [N] off the hand.

    None: nothing is lifted that would decide, and free motion contradicts the stated sign.
    """
    problem = "go against the hand's own acceleration in free motion"
    if load is not None:
        problem = f"say that what is lifted pulls up with {abs(load):.3g} N"
    where = f"{trial.file}: columns {', '.join(rig.wrist.wrench[:3])}"
    said = str(not rig.wrist.reaction).lower() if rig.wrist.reaction is not None else "true"
    return InputError(
        where, f"{problem}: the sign is the other way round", f"reaction = {said} under [gripper]"
    )


def pose_remark(trial: Trial, rig: Rig, load: float) -> str:
    """The warning where a lift shows one sign and free motion the other: readings that go with the pose."""
    where = f"{trial.file}: columns {', '.join(rig.wrist.wrench[:3])}"
    return (
        f"{where} bear {load:.3g} N of what is lifted, but go against the hand's own acceleration in free "
        "motion: they change with the pose, and loads are wrong by as much"
    )


def points_down(trial: Trial, rig: Rig) -> InputError:
    """The line for an axis that counts downwards: what is lifted would go down."""
    gripper = rig.wrist
    axis = gripper.up.lstrip("-")
    said = axis if gripper.up.startswith("-") else f"-{axis}"
    name = {str(each): name for each, name in gripper.position.items()}[axis]
    where = f"{trial.file}: column {name}"
    return InputError(where, "goes down whenever the hand bears something, as if it counted downwards",
                      f'up = "{said}" under [gripper]')  # fmt: skip


def exchanged_axes(trial: Trial, rig: Rig) -> InputError:
    """The line for position columns of the wrong axes: what is carried would pull sideways."""
    gripper = rig.wrist
    up, position = gripper.up.lstrip("-"), {str(axis): name for axis, name in gripper.position.items()}
    others = [axis for axis in AXES if axis != up and axis in position]
    across = gripper.closing if gripper.closing in others else others[0]
    swapped = position | {up: position[across], across: position[up]}
    text = ", ".join(f"{axis} = {json.dumps(swapped[axis])}" for axis in AXES if axis in swapped)
    where = f"{trial.file}: columns {position[up]}, {position[across]}"
    problem = f"say that the hand's load pulls along {across} and never along {up}: axes exchanged"
    return InputError(where, problem, f"position = {{{text}}} under [gripper]")


LEAST = 3  # numerics: samples; of fewer there is no scatter
WENT = 4  # numerics: smoothing windows of a hand that goes somewhere before what it bears is judged


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
    free = free_samples(opening, held)
    tool = free_tool(trial, rig, pose, free)
    force = applied_force(trial, rig, pose, tool)
    stiffness = rig.fingertip.normal_stiffness
    each = [grip_of(trial.t, opening, closing, pressing, stiffness) for closing in held]
    grips = [grip for grip in each if grip is not None]
    loads = [_load(grip, pose, force, tool) for grip in grips]
    lifts = [load for grip, load in zip(grips, loads, strict=True) if load and _raised(grip, pose).any()]
    return Held(grips, loads, tool, force, free, lifts)


def contradiction(trial: Trial, rig: Rig, pose: Pose, opening: np.ndarray, held: Held) -> InputError | None:
    """What to write where no grip lifts anything, None where no other reading explains it, as of slides.

    An opening of the other sign makes free motion of what was held and shows by how much better the tool's
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
              if _raised(grip, other).any()] for other, _ in others]  # fmt: skip
    least = [min(load for load in loads if load) if _lifts_all(loads) else 0.0 for loads in borne]
    best = int(np.argmax(least))
    return others[best][1](trial, rig) if least[best] > 0 else None


def _lifts_all(loads: list[float | None]) -> bool:
    """Whether every grip that goes anywhere bears something, and there is one."""
    there = [load for load in loads if load is not None]
    return bool(there) and min(there) > 0


def grip_force_of(channels: Mapping[str, Any], gripper: Gripper) -> np.ndarray | float | None:
    """What each pad presses with [N]: samples, or a number while it grips; None where it is unknown."""
    if isinstance(gripper.grip_force, str):
        return np.abs(channels[gripper.grip_force])
    if gripper.grip_force is not None:
        return float(gripper.grip_force)
    if gripper.motor_current is not None and gripper.force_per_ampere is not None:
        return np.abs(channels[gripper.motor_current]) * gripper.force_per_ampere
    return None


def _raised(grip: Grip, pose: Pose) -> np.ndarray:
    """Samples of a grip (num_samples,) in which the hand is higher than where it begins and ends.

    None where they are too few.
    """
    height = pose.position[grip.start : grip.stop] @ pose.up
    raised = height - max(height[0], height[-1]) > MOVED
    return raised & (raised.sum() > LEAST)


def _load(grip: Grip, pose: Pose, force: np.ndarray, tool: Tool) -> float | None:
    """What the hand carries while raised, or pushes while it moves along [N]: 0 where it is nothing.

    None where it never goes anywhere, which leaves nothing to judge by.
    """
    raised, gone = _raised(grip, pose), went(grip.start, grip.stop, pose)
    lifted, inside = bool(raised.any()), slice(grip.start, grip.stop)
    moved, way = (raised, pose.up) if lifted else (gone, pose.across)
    load = borne(force[inside][moved] @ way, pose, tool)
    return load if lifted or load is None else abs(load)


def went(start: int, stop: int, pose: Pose) -> np.ndarray:
    """Which samples from `start` to `stop` the hand has gone away from where it is at first."""
    return np.linalg.norm(pose.position[start:stop] - pose.position[start], axis=1) > MOVED


def borne(load: np.ndarray, pose: Pose, tool: Tool) -> float | None:
    """What samples of a load (num_samples,) [N] agree on, 0 where it is within its noise; None of too few.

    Samples within one smoothing window go together.
    """
    load = load[np.isfinite(load)]
    if load.size <= LEAST:
        return None
    found = float(np.median(load))
    independent = load.size / max(1.0, pose.window / float(np.median(np.diff(pose.t))))
    scatter = max(robust_sd(load - found), tool.noise) / np.sqrt(independent)
    return found if abs(found) > SURE * scatter else 0.0


def bears(start: int, stop: int, pose: Pose, force: np.ndarray, tool: Tool) -> float | None:
    """As a grip's load [N] where it lasts still; None until the hand has gone somewhere for long enough."""
    gone, height = went(start, stop, pose), pose.position[start:stop] @ pose.up
    gone &= np.isfinite(force[start:stop]).all(axis=1)
    if gone.sum() * float(np.median(np.diff(pose.t))) < WENT * pose.window:
        return None
    raised = height[gone] - height[0] > MOVED
    up, aside = (borne(force[start:stop][gone] @ way, pose, tool) or 0.0 for way in (pose.up, pose.across))
    return up if raised.mean() > 0.5 else max(abs(up), abs(aside))


# prior: s; sd by which pads touch and let go off the opening's width by this: they are no ideal springs
LAG = 0.012
TILT = 0.01  # prior: rad; an arm whose orientation is not recorded holds its hand level by about as much
SURELY = 0.1  # chosen: s from any grip in which nothing is held for sure: a touch is known to a fifth of it
CLIPPED = 2.0  # chosen: noise scales
STRAY, STRAY_TIME = 0.3, 0.1  # chosen: N, s: a touch in free motion that is reported
NOMINAL = 1.0  # numerics: N; assumed for a grip of rigid pads whose force was not measured: any will do
HIDDEN_GRIP = (
    "a wrist sensor does not feel what the fingers press against each other with; grip_force under "
    "[gripper] would tell"
)
HALVES = (
    "columns fx1, fx2 and fy1, fy2 are the same in every sample, half of a wrist's force each: the grip is "
    "read from the fingers' distance instead"
)


def halved(trial: Trial) -> bool:
    """Whether the fingers' forces are halves of one wrist sensor's: no two fingertips feel the same."""
    pairs = [("fx1", "fx2"), ("fy1", "fy2")]
    if not all(name in trial.channels for pair in pairs for name in pair):
        return False
    same = [np.array_equal(trial.channels[a], trial.channels[b], equal_nan=True) for a, b in pairs]
    return all(same) and any(np.ptp(trial.channels[a][np.isfinite(trial.channels[a])]) > 0 for a, _ in pairs)


def from_halves(trial: Trial, rig: Rig) -> Trial:
    """A trial whose fingers' forces are halves of a wrist's, as such a gripper's."""
    c = trial.channels
    channels = {
        "x": (c["x1"] + c["x2"]) / 2, "z": (c["y1"] + c["y2"]) / 2, "opening": c["x2"] - c["x1"],
        "fx": c["fx1"] + c["fx2"], "fy": np.zeros(trial.t.size), "fz": c["fy1"] + c["fy2"],
    }  # fmt: skip
    gripper = Gripper(position={"x": "x", "z": "z"}, closing="x", frame="world", reaction=False)
    found = two_fingers(replace(trial, channels=channels), rig.model_copy(update={"gripper": gripper}))
    return replace(found, notes=(f"{trial.file}: {HALVES}", *found.notes))


def two_fingers(trial: Trial, rig: Rig) -> Trial:
    """The trial with the channels of a Cartesian two-finger hand; InputError for what cannot be.

    `touch_sd` of the result [m]: how well the openings at which the pads touch are known.
    """
    gripper = rig.wrist
    pose = pose_of(trial, gripper)
    opening = np.sum([bridged(trial.channels[name], trial.t) for name in gripper.opening], axis=0)
    pressing = grip_force_of(trial.channels, gripper)
    held = held_by(trial, rig, pose, opening, pressing)
    signs: tuple[str, ...] = ()
    if held.lifts and max(held.lifts) < 0:
        # What is lifted hangs on the hand: that shows the sign before the hand's own inertia does.
        least = min(held.lifts)
        for reaction in (True, False) if gripper.reaction is None else ():
            other = rig.model_copy(update={"gripper": gripper.model_copy(update={"reaction": reaction})})
            found = held_by(trial, other, pose, opening, pressing)
            if found.lifts and max(found.lifts) > 0:
                held, rig, signs = found, other, (pose_remark(trial, other, max(found.lifts)),)
                break
        if not signs:
            raise other_sign(trial, rig, least)
    elif held.lifts and held.tool.against:
        signs = (pose_remark(trial, rig, max(held.lifts)),)
    elif held.tool.against:
        raise other_sign(trial, rig)
    if held.grips and not held.lifts:
        text = contradiction(trial, rig, pose, opening, held)
        if text is not None:
            raise text
    loaded = [grip for grip, load in zip(held.grips, held.loads, strict=True) if load is None or load != 0]
    found = as_fingers(trial, rig, pose, held.tool, opening, held.force, loaded or held.grips, pressing)
    order = order_warnings(trial, rig, held.tool, held.free)
    named = order or tool_warnings(trial, rig, held.tool)
    return replace(found, warnings=(*found.warnings, *signs, *named))


def as_fingers(trial: Trial, rig: Rig, pose: Pose, tool: Tool, opening: np.ndarray, force: np.ndarray,
               grips: list[Grip], pressing: np.ndarray | float | None) -> Trial:  # fmt: skip
    """The trial as two fingers', from what the tool does (`force`, (num_timesteps, 3), world) and holds."""
    t = trial.t
    x, y = pose.position @ pose.across, pose.position @ pose.up
    velocity = smooth(t, pose.position, deriv=1)
    fx, fy = force @ pose.across, force @ pose.up
    free = np.ones(t.size, bool)
    for each in grips:
        free[max(each.start - 1, 0) : each.stop + 1] = False
    strays = _strays(trial, free, np.hypot(fx, fy), tool)
    for felt in (fx, fy):  # nothing is held there, whatever the wrist feels
        felt[free] = np.clip(felt[free], -CLIPPED * tool.noise, CLIPPED * tool.noise)
    grip = np.zeros(t.size)
    shown = opening.copy()
    rigid = not np.isfinite(rig.fingertip.normal_stiffness)
    for each in grips:
        inside = slice(each.start, each.stop)
        squeeze = np.maximum(each.width - opening[inside], 0.0)
        if isinstance(pressing, np.ndarray):
            grip[inside] = np.nan_to_num(pressing[inside])
        elif rigid:
            size = pressing if pressing is not None else NOMINAL
            whole = max(each.width - each.held, 1e-9)
            grip[inside] = size * (np.clip(squeeze / whole, 0.05, 1.0) if whole > 1e-6 else 1.0)
        else:
            grip[inside] = squeeze * rig.fingertip.normal_stiffness / 2
        if rigid:  # what gives is not the pads, and what is held has one width
            shown[inside] = np.maximum(shown[inside], each.width)
    closing = smooth(t, shown, deriv=1) / 2
    channels = {
        "x1": x - shown / 2, "y1": y, "vx1": velocity @ pose.across - closing, "vy1": velocity @ pose.up,
        "fx1": fx / 2 + grip, "fy1": fy / 2,
        "x2": x + shown / 2, "y2": y, "vx2": velocity @ pose.across + closing, "vy2": velocity @ pose.up,
        "fx2": fx / 2 - grip, "fy2": fy / 2,
    }  # fmt: skip
    if rig.wrist.turns:  # by which fingers and block stand askew, who are level in these channels
        closing = pose.turned[:, :, AXES.index(rig.wrist.closing)]
        channels[ROLL] = np.arcsin(np.clip(closing @ pose.up, -1.0, 1.0))
    if isinstance(pressing, np.ndarray):
        for name in ("fx1", "fx2"):
            channels[name] = np.where(np.isfinite(pressing), channels[name], np.nan)
    sds = [each.width_sd for each in grips]
    touch_sd = float(np.sqrt(np.mean(np.square(sds)))) if sds else 0.0
    touches = tuple(touch for each in grips for touch in _touches(t, opening, each))
    surely = np.ones(t.size)
    for each in grips:
        surely[(t > t[each.start] - SURELY) & (t < t[min(each.stop, t.size) - 1] + SURELY)] = 0.0
    from scipy.ndimage import maximum_filter1d  # slow to import

    wrong, step = _inertia(t, pose, tool, rig.wrist.turns, rig.gravity), float(np.median(np.diff(t)))
    # A load that changes by so much per second is off by that much of its time.
    pace = maximum_filter1d(np.abs(np.gradient(np.nan_to_num(fy), t)), _around(t, pose))
    late = np.sqrt(np.maximum(wrong[:, 1] ** 2 - tool.noise**2, 0)) / np.maximum(pace, tool.noise / step)
    timing = np.minimum(late, pose.window / 2)
    return replace(trial, channels=channels, touch_sd=touch_sd, touches=touches, timing=timing, inertia=wrong,
                   free=surely, notes=(*_notes(trial, rig, tool), *strays),
                   hidden={} if pressing is not None else {"friction": HIDDEN_GRIP})  # fmt: skip


def _inertia(t: np.ndarray, pose: Pose, tool: Tool, turns: bool, gravity: float) -> np.ndarray:
    """By how much the tool's inertia may be wrong, across and up (num_timesteps, 2) [N].

    The acceleration is smoothed. Where it jumps (a block that is set down stops the hand) the tool's share
    is wrong for as long as the window, by about what a window twice as wide makes of it in turn (root mean
    square). What free motion leaves unexplained is the tool's own too, and a tilt that is not recorded turns
    its weight sideways.
    """
    from scipy.ndimage import uniform_filter1d  # slow to import

    axes = np.stack([pose.across, pose.up], axis=1)
    once, wider = (smooth(t, pose.position, 2, times * pose.window) @ axes for times in (1, 2))
    mean = uniform_filter1d((wider - once) ** 2, _around(t, pose), axis=0)
    wrong = tool.inertia * np.sqrt(np.maximum(mean, 0.0))  # a running sum's rounding goes below 0
    wrong = np.hypot(wrong, tool.noise)
    if not turns:
        wrong[:, 0] = np.hypot(wrong[:, 0], tool.mass * gravity * TILT)
    return wrong


def _around(t: np.ndarray, pose: Pose) -> int:
    """Samples of the smoothing window, an odd number."""
    return max(3, round(pose.window / float(np.median(np.diff(t)))) // 2 * 2 + 1)


def _strays(trial: Trial, free: np.ndarray, felt: np.ndarray, tool: Tool) -> list[str]:
    """Where the wrist feels something for a while though the opening says that nothing is held."""
    t, out = trial.t, []
    for start, stop in runs(free & (np.nan_to_num(felt) > max(2 * SURE * tool.noise, STRAY))):
        if t[stop - 1] - t[start] > STRAY_TIME:
            most = float(np.nanmax(felt[start:stop]))
            when = f"from {t[start]:.2f} to {t[stop - 1]:.2f} s, with up to {most:.2g} N"
            out.append(f"{trial.file}: the hand touches something {when}, though it holds nothing")
    return out


def _touches(t: np.ndarray, opening: np.ndarray, grip: Grip) -> list[tuple[float, float]]:
    """When the opening passes the width, closing and opening again, and how uncertain that is [s]."""
    found = []
    for i in (grip.start, grip.stop):
        if not 0 < i < t.size:
            continue
        before, after = opening[i - 1] - grip.width, opening[i] - grip.width
        if before * after > 0:
            continue
        period = float(t[i] - t[i - 1])
        share = before / (before - after) if before != after else 0.5
        speed = max(abs(after - before) / period, 1e-3)
        # Linear between samples, of which the contact bends the way: uniform over half of them.
        sd = float(np.sqrt((grip.width_sd / speed) ** 2 + period**2 / 48 + LAG**2))
        found.append((float(t[i - 1] + share * period), sd))
    return found


def _notes(trial: Trial, rig: Rig, tool: Tool) -> tuple[str, ...]:
    """What was found of the tool, for the reader."""
    gripper = rig.wrist
    if gripper.tool_mass is not None and gripper.sensor_axes is not None and gripper.reaction is not None:
        return ()
    mass = "as given" if gripper.tool_mass else "from free motion"
    text = f"{trial.file}: tool of {tool.mass:.3g} kg on the sensor ({mass})"
    if tool.mass <= 0:  # readings that go with the pose hide it
        text = f"{trial.file}: free motion does not tell what the tool on the sensor weighs"
    if gripper.sensor_axes is None and gripper.frame == "sensor":
        up = tool.axes @ direction(gripper.up)
        names = gripper.wrench[:3]
        largest = int(np.argmax(np.abs(up)))
        sign = "-" if up[largest] < 0 else ""
        text += f"; a load that hangs on it shows in {sign}{names[largest]}"
    return (text,)
