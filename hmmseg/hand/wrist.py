"""A gripper with a wrist sensor, converted to the two fingers of the contact equations.

The wrist feels the sum of the forces of both fingers; each finger's channels get half of it. The wrist does
not feel the grip itself. If no grip force is recorded, the pads' elasticity gives it: their compression is
the opening at which they touched (`hmmseg.hand.grips`) less the opening at which they are held. It shows
when something is held, but is no measured force: it does not bound friction.

A hand that is raised with an object bears its weight. If no hold lifts anything, the columns are interpreted
in the other ways that a rig may have it, and the one in which every hold lifts something is suggested.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.grips import Grip, closings, free_samples, grip_of
from hmmseg.hand.plausibility import Finding, changed
from hmmseg.hand.sensing import tool_warnings
from hmmseg.hand.tool import Pose, Tool, applied_force, free_tool, order_warnings, pose_of, smooth
from hmmseg.io.rig import AXES, Gripper, Rig, direction
from hmmseg.io.trial import ROLL, Trial
from hmmseg.levels import AROUND, MOVED, SHOWN, SURE
from hmmseg.robust import bridged, extent, robust_sd, runs

WIDEST = 1.0  # limit: m; no parallel gripper opens further
NARROW = 2e-4  # limit: m; an opening that changes less does not move
CANCELLED = 0.05  # limit: of the travel of either finger, in their sum


def check_gripper(trial: Trial, rig: Rig) -> list[Finding]:
    """Openings in other units, without motion, or of one finger only."""
    gripper = rig.wrist
    for name in gripper.opening:
        values = trial.channels[name]
        widest, swing = float(np.nanmax(np.abs(values))), extent(values)
        if swing > WIDEST:
            unit, text = ("cm", 'cm (or "in")') if swing < 15 else ("mm", "mm (or %)")
            problem = f"swings by {swing:.4g} m, a gripper by less than {WIDEST:g} m: it looks like {text}"
            return [Finding(name, problem, changed([name], rig, unit=unit))]
        if swing < NARROW:
            problem = f"changes by {swing:.2g} m in all (of {widest:.3g} m)"
            raise InputError(f"{trial.file}: column {name}", problem, "a gripper that closes and opens, in m")
    return _cancelling(trial, rig) or _one_finger(rig)


def _cancelling(trial: Trial, rig: Rig) -> list[Finding]:
    """Travels of two fingers, one counted the other way: their sum stays while they move."""
    names = rig.wrist.opening
    if len(names) < 2:
        return []
    first, second = (trial.channels[name] for name in names)
    total = first + second
    if not np.isfinite(total).any() or extent(total) > CANCELLED * min(extent(first), extent(second)):
        return []
    name = names[int(np.nanmedian(second) < np.nanmedian(first))]
    problem = f"moves while {' + '.join(names)} stays as it is: it counts the other way"
    return [Finding(name, problem, changed([name], rig, sign=-1))]


def _one_finger(rig: Rig) -> list[Finding]:
    """An opening of one column that is named after one of two fingers."""
    gripper = rig.wrist
    name, *more = gripper.opening
    entry = (rig.columns | rig.topics).get(name)
    of_one = re.search(r"finger.*(\d|left|right)|(left|right).*finger", name.lower()) is not None
    if more or not of_one or (entry is not None and entry.unit is not None):
        return []
    problem = "is named after one finger, and would show half of the opening: widths halved"
    return [Finding(name, problem, changed([name], rig, unit=2.0), certain=False)]


def other_sign(trial: Trial, rig: Rig, load: float | None = None) -> InputError:
    """The error for a flipped sign: lifts take weight `load` [N] off the hand.

    None: nothing is lifted, and free motion contradicts the stated sign.
    """
    problem = "go against the hand's own acceleration in free motion"
    if load is not None:
        problem = f"say that what is lifted pulls up with {abs(load):.3g} N"
    where = f"{trial.file}: columns {', '.join(rig.wrist.wrench[:3])}"
    remedy = f"reaction = {'false' if rig.wrist.reaction else 'true'} under [gripper]"
    return InputError(where, f"{problem}: the sign is the other way round", remedy)


def pose_remark(trial: Trial, rig: Rig, load: float) -> str:
    """The warning if lifts show one sign and free motion the other: readings that depend on the pose."""
    where = f"{trial.file}: columns {', '.join(rig.wrist.wrench[:3])}"
    return (
        f"{where} bear {load:.3g} N of what is lifted, but go against the hand's own acceleration in free "
        "motion: they change with the pose, and loads are wrong by as much"
    )


LEAST = 3  # numerics: samples; fewer have no scatter
WENT = 8  # numerics: smoothing windows of motion after which the load is judged


@dataclass(frozen=True)
class Held:
    """Grips and their loads.

    Attributes:
        grips: in order.
        loads: of each grip [N], None if the hand does not move in it.
        tool: from free motion.
        force: (num_timesteps, 3) of the tool on its environment, in the world's axes [N].
        free: (num_timesteps,) samples that surely belong to no grip.
        lifts: nonzero loads of the grips in which the hand is raised [N].
    """

    grips: list[Grip]
    loads: list[float | None]
    tool: Tool
    force: np.ndarray
    free: np.ndarray
    lifts: list[float]


def find_grips(trial: Trial, rig: Rig, pose: Pose, opening: np.ndarray, pressing: np.ndarray | float | None
            ) -> Held:  # fmt: skip
    """Grips of the opening (num_timesteps,) [m]; `pressing` as from `grip_force_of`."""
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
    """The error if no grip lifts anything and another interpretation of the rig explains that, else None.

    An opening of the other sign takes holds for free motion, which the noise about the tool's model shows;
    axes that are exchanged or reversed leave that noise unchanged.
    """
    gripper, flipped = rig.wrist, None
    with contextlib.suppress(InputError):
        flipped = find_grips(trial, rig, pose, -opening, None)
    if flipped is not None and _lifts_all(flipped.loads) and flipped.tool.noise < held.tool.noise:
        name = gripper.opening[0]
        widest = float(sum(bridged(trial.channels[name], trial.t).max() for name in gripper.opening))
        remedy = Finding(name, "", changed([name], rig, sign=-1, offset=round(widest, 4))).remedy
        problem = "is widest while the hand carries something: it counts how far the gripper has closed"
        return InputError(f"{trial.file}: column {name}", problem, remedy)
    least = []
    for other in (replace(pose, up=-pose.up), replace(pose, up=pose.across, across=pose.up)):
        lifting = [grip for grip in held.grips if _raised(grip, other).any()]
        loads = [_load(grip, other, held.force, held.tool) for grip in lifting]
        least.append(min(load for load in loads if load) if _lifts_all(loads) else 0.0)
    if not any(least):
        return None
    up, position = gripper.up.lstrip("-"), {str(axis): name for axis, name in gripper.position.items()}
    if least[0] >= least[1]:
        reversed_up = up if gripper.up.startswith("-") else f"-{up}"
        problem = "goes down whenever the hand bears something, as if it counted downwards"
        remedy = f'up = "{reversed_up}" under [gripper]'
        return InputError(f"{trial.file}: column {position[up]}", problem, remedy)
    others = [axis for axis in AXES if axis != up and axis in position]
    across = gripper.closing if gripper.closing in others else others[0]
    swapped = position | {up: position[across], across: position[up]}
    text = ", ".join(f"{axis} = {json.dumps(swapped[axis])}" for axis in AXES if axis in swapped)
    problem = f"say that the hand's load pulls along {across} and never along {up}: axes exchanged"
    where = f"{trial.file}: columns {position[up]}, {position[across]}"
    return InputError(where, problem, f"position = {{{text}}} under [gripper]")


def opening_of(trial: Trial, gripper: Gripper) -> np.ndarray:
    """Opening (num_timesteps,) [m], gaps bridged."""
    return np.sum([bridged(trial.channels[name], trial.t) for name in gripper.opening], axis=0)


def width_error(grips: list[Grip]) -> float:
    """Uncertainty [m] of the openings at which the pads touch, 0 without any grip."""
    return float(np.sqrt(np.mean([grip.width_sd**2 for grip in grips]))) if grips else 0.0


def _lifts_all(loads: list[float | None]) -> bool:
    """Whether there are grips with motion, and all of them bear something."""
    there = [load for load in loads if load is not None]
    return bool(there) and min(there) > 0


def grip_force_of(channels: Mapping[str, Any], gripper: Gripper) -> np.ndarray | float | None:
    """Force of each pad [N], by sample or as a constant while it grips; None if unknown."""
    if isinstance(gripper.grip_force, str):
        return np.abs(channels[gripper.grip_force])
    if gripper.grip_force is not None:
        return float(gripper.grip_force)
    if gripper.motor_current is not None and gripper.force_per_ampere is not None:
        return np.abs(channels[gripper.motor_current]) * gripper.force_per_ampere
    return None


def _raised(grip: Grip, pose: Pose) -> np.ndarray:
    """Samples (num_samples,) of a grip in which the hand is higher than at both its ends; none if too few."""
    height = pose.position[grip.start : grip.stop] @ pose.up
    raised = height - max(height[0], height[-1]) > MOVED
    return raised & (raised.sum() > LEAST)


def _load(grip: Grip, pose: Pose, force: np.ndarray, tool: Tool) -> float | None:
    """Load [N] carried while raised, or pushed along; 0 if insignificant, None if the hand does not move."""
    raised, moved = _raised(grip, pose), has_moved(grip.start, grip.stop, pose)
    lifted, force = bool(raised.any()), force[grip.start : grip.stop]
    load = median_load(force[raised] @ pose.up if lifted else force[moved] @ pose.across, pose, tool)
    return load if lifted or load is None else abs(load)


def has_moved(start: int, stop: int, pose: Pose) -> np.ndarray:
    """Samples from `start` to `stop` in which the hand has left its place at the start."""
    return np.linalg.norm(pose.position[start:stop] - pose.position[start], axis=1) > MOVED


def median_load(load: np.ndarray, pose: Pose, tool: Tool) -> float | None:
    """Median of a load (num_samples,) [N], 0 if within its noise; None of too few samples.

    Samples within one smoothing window are not independent.
    """
    load = load[np.isfinite(load)]
    if load.size <= LEAST:
        return None
    found = float(np.median(load))
    independent = load.size / max(1.0, pose.window / float(np.median(np.diff(pose.t))))
    scatter = max(robust_sd(load - found), tool.noise) / np.sqrt(independent)
    return found if abs(found) > SURE * scatter else 0.0


def bears(start: int, stop: int, pose: Pose, force: np.ndarray, tool: Tool) -> float | None:
    """Load [N] of a grip that still lasts; None until the hand has moved for long enough."""
    gone, height = has_moved(start, stop, pose), pose.position[start:stop] @ pose.up
    gone &= np.isfinite(force[start:stop]).all(axis=1)
    if gone.sum() * float(np.median(np.diff(pose.t))) < WENT * pose.window:
        return None
    raised = height[gone] - height[0] > MOVED
    moving = force[start:stop][gone]
    up, aside = (median_load(moving @ way, pose, tool) or 0.0 for way in (pose.up, pose.across))
    return up if raised.mean() > 0.5 else max(abs(up), abs(aside))


# prior: s; sd of touch and release about the times at which the opening passes the width: pads are no ideal
# springs
LAG = 0.012
TILT = 0.01  # prior: rad; tilt of a hand whose orientation is not recorded
NOMINAL = 1.0  # numerics: N; force assumed for a grip of rigid pads if none was measured; any will do
HIDDEN_GRIP = (
    "a wrist sensor does not feel what the fingers press against each other with; grip_force under "
    "[gripper] would tell"
)
HALVES = (
    "columns fx1, fx2 and fy1, fy2 are the same in every sample, half of a wrist's force each: the grip is "
    "read from the fingers' distance instead"
)


def is_halved(trial: Trial) -> bool:
    """Whether the fingers' forces are halves of one wrist sensor's: two fingertips never feel the same."""
    pairs = [("fx1", "fx2"), ("fy1", "fy2")]
    if not all(name in trial.channels for name in ("x1", *pairs[0], *pairs[1])):
        return False
    same = [np.array_equal(trial.channels[a], trial.channels[b], equal_nan=True) for a, b in pairs]
    return all(same) and any(np.ptp(trial.channels[a][np.isfinite(trial.channels[a])]) > 0 for a, _ in pairs)


def join_halves(trial: Trial, rig: Rig) -> Trial:
    """The two fingers of a trial whose forces are halves of a wrist's, read as that of a gripper."""
    c = trial.channels
    channels = {
        "x": (c["x1"] + c["x2"]) / 2, "z": (c["y1"] + c["y2"]) / 2, "opening": c["x2"] - c["x1"],
        "fx": c["fx1"] + c["fx2"], "fy": np.zeros(trial.t.size), "fz": c["fy1"] + c["fy2"],
    }  # fmt: skip
    gripper = Gripper(position={"x": "x", "z": "z"}, closing="x", frame="world", reaction=False)
    found = two_fingers(replace(trial, channels=channels), rig.model_copy(update={"gripper": gripper}))
    return replace(found, notes=(f"{trial.file}: {HALVES}", *found.notes))


def _with_still_axes(trial: Trial, rig: Rig) -> Trial:
    """The trial with zeros for what reads the same in every row and may: a torque, a place along an axis on
    which the tool does not move. InputError for any other channel without readings."""
    gripper, channels = rig.wrist, dict(trial.channels)
    may = {*gripper.wrench[3:], *(n for a, n in gripper.position.items() if a != gripper.up.lstrip("-"))}
    for name, values in channels.items():
        if np.isfinite(values).any():
            continue
        if name not in may:
            said = (f.problem.partition(",")[0] for f in trial.faults if f.channel == name)
            where = f"{trial.file}: column {name}"
            raise InputError(where, next(said, "is empty"), "readings of a working sensor")
        channels[name] = np.zeros(trial.t.size)
    return replace(trial, channels=channels)


def two_fingers(trial: Trial, rig: Rig) -> Trial:
    """The trial as that of a Cartesian two-finger hand; InputError for contradictions.

    `touch_sd` of the result [m]: uncertainty of the openings at which the pads touch.
    """
    gripper = rig.wrist
    trial = _with_still_axes(trial, rig)
    pose = pose_of(trial, gripper)
    opening = opening_of(trial, gripper)
    pressing = grip_force_of(trial.channels, gripper)
    held = find_grips(trial, rig, pose, opening, pressing)
    signs: tuple[str, ...] = ()
    if held.lifts and max(held.lifts) < 0:
        # Lifted objects weigh on the hand, which shows the sign more surely than the hand's own inertia.
        least = min(held.lifts)
        for reaction in (True, False) if gripper.reaction is None else ():
            other = rig.model_copy(update={"gripper": gripper.model_copy(update={"reaction": reaction})})
            found = find_grips(trial, other, pose, opening, pressing)
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
        error = contradiction(trial, rig, pose, opening, held)
        if error is not None:
            raise error
    loaded = [grip for grip, load in zip(held.grips, held.loads, strict=True) if load is None or load != 0]
    found = as_fingers(trial, rig, pose, held.tool, opening, held.force, loaded or held.grips, pressing)
    order = order_warnings(trial, rig, held.tool, held.free)
    named = order or tool_warnings(trial, rig, held.tool)
    return replace(found, warnings=(*found.warnings, *signs, *named))


def as_fingers(trial: Trial, rig: Rig, pose: Pose, tool: Tool, opening: np.ndarray, force: np.ndarray,
               grips: list[Grip], pressing: np.ndarray | float | None) -> Trial:  # fmt: skip
    """The trial as that of two fingers, from the tool's `force` (num_timesteps, 3) [N, world] and grips."""
    t = trial.t
    x, y = pose.position @ pose.across, pose.position @ pose.up
    velocity = smooth(t, pose.position, deriv=1)
    fx, fy = force @ pose.across, force @ pose.up
    free = np.ones(t.size, bool)
    for each in grips:
        free[max(each.start - 1, 0) : each.stop + 1] = False
    strays = _strays(trial, free, np.hypot(fx, fy), tool, pose.window)
    for felt in (fx, fy):  # nothing is held there, whatever the wrist feels
        felt[free] = np.clip(felt[free], -SHOWN * tool.noise, SHOWN * tool.noise)
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
        if rigid and pressing is None:  # the drive yields instead of the pads, and the object has one width
            shown[inside] = np.maximum(shown[inside], each.width)
    closing = smooth(t, shown, deriv=1) / 2
    channels = {
        "x1": x - shown / 2, "y1": y, "vx1": velocity @ pose.across - closing, "vy1": velocity @ pose.up,
        "fx1": fx / 2 + grip, "fy1": fy / 2,
        "x2": x + shown / 2, "y2": y, "vx2": velocity @ pose.across + closing, "vy2": velocity @ pose.up,
        "fx2": fx / 2 - grip, "fy2": fy / 2,
    }  # fmt: skip
    if rig.wrist.turns:  # the roll of fingers and block, who are level in these channels
        closing = pose.turned[:, :, AXES.index(rig.wrist.closing)]
        channels[ROLL] = np.arcsin(np.clip(closing @ pose.up, -1.0, 1.0))
    if isinstance(pressing, np.ndarray):
        for name in ("fx1", "fx2"):
            channels[name] = np.where(np.isfinite(pressing), channels[name], np.nan)
    touches = tuple(touch for each in grips for touch in _touches(t, opening, each))
    surely = np.ones(t.size)
    for each in grips:
        surely[(t > t[each.start] - AROUND) & (t < t[min(each.stop, t.size) - 1] + AROUND)] = 0.0
    from scipy.ndimage import maximum_filter1d  # slow to import

    wrong, step = _inertia(t, pose, tool, rig.wrist.turns, rig.gravity), float(np.median(np.diff(t)))
    # The error of the force, in units of time: divided by how fast the load changes.
    pace = maximum_filter1d(np.abs(np.gradient(np.nan_to_num(fy), t)), _around(t, pose))
    late = np.sqrt(np.maximum(wrong[:, 1] ** 2 - tool.noise**2, 0)) / np.maximum(pace, tool.noise / step)
    timing = np.minimum(late, pose.window / 2)
    # A measured force shows what the pads give, so that widths need not rely on the opening at the touch.
    grips_sd = 0.0 if isinstance(pressing, np.ndarray) else width_error(grips)
    touch_sd = float(np.hypot(grips_sd, trial.touch_sd))
    return replace(trial, channels=channels, touch_sd=touch_sd, touches=touches, timing=timing, inertia=wrong,
                   free=surely, notes=(*_notes(trial, rig, tool), *strays),
                   hidden={} if pressing is not None else {"friction": HIDDEN_GRIP})  # fmt: skip


def _inertia(t: np.ndarray, pose: Pose, tool: Tool, turns: bool, gravity: float) -> np.ndarray:
    """Standard error of the tool's inertial force, across and up (num_timesteps, 2) [N].

    Where the acceleration jumps (a block that is set down stops the hand), smoothing makes it wrong for the
    length of the window, by about the change that a window twice as wide makes (root mean square). The noise
    of free motion adds to it, and so does an unrecorded tilt, which turns the tool's weight sideways.
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
    """Samples in the smoothing window, an odd number."""
    return max(3, round(pose.window / float(np.median(np.diff(t)))) // 2 * 2 + 1)


def _strays(trial: Trial, free: np.ndarray, felt: np.ndarray, tool: Tool, window: float) -> list[str]:
    """Reports of forces in free motion, by the opening, that last."""
    t, out = trial.t, []
    for start, stop in runs(free & (np.nan_to_num(felt) > 2 * SURE * tool.noise)):
        if t[stop - 1] - t[start] > window:
            most = float(np.nanmax(felt[start:stop]))
            when = f"from {t[start]:.2f} to {t[stop - 1]:.2f} s, with up to {most:.2g} N"
            out.append(f"{trial.file}: the hand touches something {when}, though it holds nothing")
    return out


def _touches(t: np.ndarray, opening: np.ndarray, grip: Grip) -> list[tuple[float, float]]:
    """Times at which the opening passes the width, closing and opening again, and their sds [s]."""
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
        # Interpolated linearly, though the contact bends the course: uniform over half a sample.
        sd = float(np.sqrt((grip.width_sd / speed) ** 2 + period**2 / 48 + LAG**2))
        found.append((float(t[i - 1] + share * period), sd))
    return found


def _notes(trial: Trial, rig: Rig, tool: Tool) -> tuple[str, ...]:
    """What was found about the tool, for the reader."""
    gripper = rig.wrist
    if gripper.tool_mass is not None and gripper.sensor_axes is not None and gripper.reaction is not None:
        return ()
    mass = "as given" if gripper.tool_mass else "from free motion"
    text = f"{trial.file}: tool of {tool.mass:.3g} kg on the sensor ({mass})"
    if tool.mass <= 0:  # readings that depend on the pose hide it
        text = f"{trial.file}: free motion does not tell what the tool on the sensor weighs"
    if gripper.sensor_axes is None and gripper.frame == "sensor":
        up = tool.axes @ direction(gripper.up)
        names = gripper.wrench[:3]
        largest = int(np.argmax(np.abs(up)))
        sign = "-" if up[largest] < 0 else ""
        text += f"; a load that hangs on it shows in {sign}{names[largest]}"
    return (text,)
