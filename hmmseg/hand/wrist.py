"""A gripper with a sensor in its wrist as the two fingers that the contact equations know.

The wrist feels the sum of what both fingers do; each finger's channels hold half of it. What
they press against each other with does not reach the wrist. Where no grip force is recorded, the
pads' own spring gives it: their squeeze is the opening at which they touched less the one they are
held at. That says when something is held, and where the touch lies within what
the slowing of the closing leaves open, but is no measured force: friction is not bounded by it.

A hand that is raised with what it holds bears it. Where no hold lifts anything, the columns are read the
other ways that a rig may have it, and the way in which the hand lifts something every time is what to write.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.plausibility import REACH, Finding, all_changed, changed, length_unit
from hmmseg.hand.sensing import tool_warnings
from hmmseg.hand.signals import grouped
from hmmseg.hand.tool import Pose, Tool, applied_force, free_tool, order_warnings, pose_of, smooth
from hmmseg.io.rig import AXES, Gripper, Rig, direction
from hmmseg.io.trial import ROLL, Trial
from hmmseg.levels import MOVED, SURE
from hmmseg.robust import bridged, robust_sd, runs, white_sd

STEP = 0.02  # numerics: s; speeds are taken over this: a gripper's motor changes them no faster
SLOWED = 0.9  # chosen: share of its speed that a closing keeps until the first touch
ABRUPT = 0.5  # chosen: share of its speed that a closing loses from one step to the next at a hard touch
SOFT = 0.1  # prior: of what gives in a grip: its touch is known no better, as pads are no ideal springs
GIVE = (1e-3, 1.5e-3)  # prior: m, mean and sd: what pads and drive give in a grip, before anything is seen
WRONG = 0.2  # prior: how often one of the estimates of the touch is of something else
TAIL, NODES, GRID = (
    4.0,
    400,
    1e-4,
)  # numerics: degrees of freedom of the prior; its grid, and least extent [m]
REST = 0.1  # chosen: share of an opening's way, or of its top speed, that is next to none: the gripper stands
LEAST_CLOSING = 1e-3  # limit: m; a smaller swing of the opening is no grip


@dataclass(frozen=True)
class Grip:
    """One closing on something: samples [start, stop) in which the pads touch it.

    `held` [m]: the opening at which it stands; `width` [m] and `width_sd`: the opening at which both
    pads just touch.
    """

    start: int
    stop: int
    held: float
    width: float
    width_sd: float


def closings(opening: np.ndarray) -> list[tuple[int, int, int]]:
    """Closings that end in a stand, as samples (begun, least, opened), by turning points.

    A swing counts where it is a tenth of the whole way and beyond the noise.
    """
    noise = white_sd(opening)
    swing = max(REST * float(np.ptp(opening)), 2 * SURE * noise, LEAST_CLOSING)
    turning, last = [0], 0
    rising: bool | None = None
    for i, value in enumerate(opening):
        if rising is None:
            if abs(value - opening[0]) > swing:
                rising, last = bool(value > opening[0]), i
        elif (value > opening[last]) == rising:
            last = i
        elif abs(value - opening[last]) > swing:
            turning.append(last)
            rising, last = not rising, i
    turning += [last] * (last != turning[-1])
    turning += [len(opening) - 1] * (turning[-1] != len(opening) - 1)
    found = []
    for before, least, after in zip(turning, turning[1:], [*turning[2:], turning[-1]], strict=False):
        if opening[before] - opening[least] > swing / 2:
            found.append((before, least, after))
    return found


def grip_of(t: np.ndarray, opening: np.ndarray, active: np.ndarray, closing: tuple[int, int, int],
            give: float | None) -> Grip | None:  # fmt: skip
    """The grip that a closing ends in; None where the opening never stands.

    `active` (num_timesteps,): where the wrist feels something; `give` [m]: what the pads give while
    held, where it is known.
    """
    begun, least, opened = closing
    floor = float(opening[least])
    ceiling = min(float(opening[begun]), float(opening[opened])) if opened > least else float(opening[begun])
    inside = np.arange(begun, opened + 1)
    low = inside[opening[inside] <= floor + REST * (ceiling - floor)]
    held, first, last = float(np.median(opening[low])), int(low[0]), int(low[-1])
    if give is not None:
        width, sd = held + give, 0.0
    else:
        released = _release(t, opening, active, last, opened, held)
        width, sd = _together([_touch(t, opening, begun, first, held), *released], held, ceiling)
    start = int(inside[np.argmax(opening[inside] <= width)])
    after = np.flatnonzero(opening[last : opened + 1] > width)
    stop = int(last + after[0]) if after.size else opened + 1
    return Grip(start, stop, held, width, sd) if stop - start > 2 else None


def _coarse(t: np.ndarray, opening: np.ndarray, start: int, stop: int) -> np.ndarray:
    """The opening [m] every STEP, means of what lies within, of samples [start, stop)."""
    group = max(1, int(STEP / float(np.median(np.diff(t))) + 1e-6))
    return grouped(opening[start:stop], group)[0]


def _kink(way: np.ndarray, noise: float) -> tuple[float, float] | None:
    """Where a way (n,) that leaves a stand takes off [m], and its sd; None where noise hides it."""
    if way.size < 4:
        return None
    third = way[3:] - 3 * way[2:-1] + 3 * way[1:-2] - way[:-3]
    at = int(np.argmax(third))
    if third[at] < SURE * np.sqrt(20) * noise:
        return None
    return float(way[at + 2]), max(float(way[at + 3] - way[at + 1]) / 4, noise)


def _noise(opening: np.ndarray) -> float:
    """Noise sd [m] of one sample of the opening."""
    return max(white_sd(opening), 1e-6)


def _touch(t: np.ndarray, opening: np.ndarray, begun: int, first: int, held: float) -> tuple[float, float]:
    """Touch while closing [m]: between where it begins to slow down and where it has most."""
    way = _coarse(t, opening, begun, first + max(4, int(4 * STEP / np.median(np.diff(t)))))
    speed = way[:-1] - way[1:]
    fast = np.flatnonzero(speed >= SLOWED * speed.max()) if speed.size else np.zeros(0, int)
    early = float(opening[begun])
    if fast.size:
        at = int(fast[-1])
        stopped = at + 1 >= speed.size or speed[at + 1] < ABRUPT * speed[at]
        early = float(way[at] if stopped else way[at + 1])  # a step that ends in a stop may end in the touch
    kink = _kink(way[::-1], _noise(opening))
    late = held if kink is None else kink[0]
    early, late = max(early, late, held), max(min(early, late), held)
    return (early + late) / 2, max((early - late) / np.sqrt(12), _noise(opening))


def _release(t: np.ndarray, opening: np.ndarray, active: np.ndarray, last: int, opened: int, held: float
             ) -> list[tuple[float, float]]:  # fmt: skip
    """Openings [m] at which the fingers took off, and at which what the wrist felt ended, with sds."""
    found = []
    lead = max(3, int(3 * STEP / np.median(np.diff(t))))
    way = _coarse(t, opening, max(last - lead, 0), opened + 1)
    top = float(opening[opened]) if opened > last else held
    wide = np.flatnonzero(way > (held + top) / 2)
    kink = _kink(way[: wide[0] + 2] if wide.size else way, _noise(opening))
    if kink is not None and kink[0] > held:
        found.append(kink)
    felt = np.flatnonzero(active[last : opened + 1])
    if felt.size and last + felt[-1] < opened and active[last : last + felt[-1] + 1].all():
        i = int(last + felt[-1])
        before, after = float(opening[i]), float(opening[i + 1])
        if before > held:
            found.append(((before + after) / 2, abs(after - before) / np.sqrt(12)))
    return found


def _together(estimates: list[tuple[float, float]], held: float, top: float) -> tuple[float, float]:
    """Mean and sd [m] of the opening at the touch, between the one held and the widest, `top`.

    What pads and drive give is the prior (Student-t); each estimate is right within its sd, or is of
    something else (a finger that drags the block on, an opening in two steps) and shows nothing.
    """
    width = np.linspace(held, max(top, held + GRID), NODES)
    log_density = -(TAIL + 1) / 2 * np.log1p(((width - held - GIVE[0]) / GIVE[1]) ** 2 / TAIL)
    for value, sd in estimates:
        sd = max(sd, float(width[1] - width[0]))
        right = np.exp(-0.5 * ((width - value) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        log_density += np.log((1 - WRONG) * right + WRONG / float(width[-1] - width[0]))
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    mean = float(density @ width)
    return mean, max(float(np.sqrt(density @ (width - mean) ** 2)), SOFT * (mean - held))


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
    held, free = closings(opening), np.ones(opening.size, bool)
    for begun, least, opened in held:  # surely free is what is more open than halfway back
        top = min(opening[begun], opening[opened]) if opened > least else opening[begun]
        inside = slice(begun, opened + 1)
        free[inside] &= ~(opening[inside] < opening[least] + 0.5 * (top - opening[least]))
    tool = free_tool(trial, rig, pose, free)
    force = applied_force(trial, rig, pose, tool)
    active = np.linalg.norm(np.nan_to_num(force), axis=1) > SURE * tool.noise
    each = [grip_of(trial.t, opening, active, c, give_of(rig, pressing, opening, c)) for c in held]
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


def grip_force_of(trial: Trial, gripper: Gripper) -> np.ndarray | float | None:
    """What each pad presses with [N]: samples, or a number while it grips; None where it is unknown."""
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
        low = opening[inside] <= opening[least] + REST * (opening[begun] - opening[least])
        force = float(np.nanmedian(pressing[inside][low]))
    return 2 * force / rig.fingertip.normal_stiffness if np.isfinite(force) else None


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
    inside = slice(grip.start, grip.stop)
    moved = _raised(grip, pose)
    lifted = bool(moved.any())
    if not lifted:
        moved = np.linalg.norm(pose.position[inside] - pose.position[grip.start], axis=1) > MOVED
    load = force[inside][moved] @ (pose.up if lifted else pose.across)
    load = load[np.isfinite(load)]
    if load.size <= LEAST:
        return None
    scatter = max(robust_sd(load - np.median(load)), tool.noise)
    found = float(np.median(load))
    if abs(found) <= SURE * scatter / np.sqrt(load.size / TOGETHER):
        return 0.0
    return found if lifted else abs(found)


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
    pressing = grip_force_of(trial, gripper)
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
