"""A gripper with a sensor in its wrist as the two fingers that the contact equations know.

The wrist feels the sum of what both fingers do; each finger's half of it stands in the channels. What
they press against each other with does not reach the wrist. Where no grip force is recorded, the
pads' own spring tells it: their squeeze is the opening at which they touched less the one they are
held at (`hmmseg.hand.opening`). That says when something is held, and where the touch lies within what
the slowing of the closing leaves open, but is no measured force: friction is not bounded by it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.hand.carried import ACTIVE, contradiction, grip_force_of, held_by
from hmmseg.hand.force_units import tool_warnings
from hmmseg.hand.gripper_signs import lifts_pull
from hmmseg.hand.opening import Grip
from hmmseg.hand.pose import Pose, pose_of, smooth
from hmmseg.hand.quaternion_order import order_warnings
from hmmseg.hand.tool import Tool
from hmmseg.io.gripper import AXES, Gripper, direction
from hmmseg.io.rig import Rig
from hmmseg.io.trial import ROLL, Trial
from hmmseg.robust import bridged

# chosen: s; pads touch and let go off the opening's width by this: they are no ideal springs
LAG = 0.012
TILT = 0.01  # chosen: rad; an arm whose orientation is not recorded holds its hand level by about as much
SURELY = 0.1  # chosen: s from any grip in which nothing is held for sure: a touch is known to a fifth of it
CLIPPED = 2.0  # chosen: noise scales
STRAY, STRAY_TIME = 0.3, 0.1  # chosen: N, s: a touch in free motion that is told
NOMINAL = 1.0  # chosen: N; stands for a grip of rigid pads whose force nobody measured: any will do
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
    gripper = rig.gripper
    assert gripper is not None
    pose = pose_of(trial, gripper)
    opening = np.sum([bridged(trial.channels[name], trial.t) for name in gripper.opening], axis=0)
    pressing = grip_force_of(trial, gripper)
    held = held_by(trial, rig, pose, opening, pressing)
    if held.lifts and max(held.lifts) < 0:
        raise lifts_pull(trial, rig, min(held.lifts))
    if held.grips and not held.lifts:
        text = contradiction(trial, rig, pose, opening, held)
        if text is not None:
            raise text
    loaded = [grip for grip, load in zip(held.grips, held.loads, strict=True) if load is None or load != 0]
    found = as_fingers(trial, rig, pose, held.tool, opening, held.force, loaded or held.grips, pressing)
    order = order_warnings(trial, rig, held.tool, held.free)
    return replace(found, warnings=(*found.warnings, *order, *tool_warnings(trial, rig, held.tool)))


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
    assert rig.gripper is not None
    if rig.gripper.turns:  # by which fingers and block stand askew, who are level in these channels
        closing = pose.turned[:, :, AXES.index(rig.gripper.closing)]
        channels[ROLL] = np.arcsin(np.clip(closing @ pose.up, -1.0, 1.0))
    if pressing is not None and not isinstance(pressing, float):
        missing = ~np.isfinite(pressing)
        for name in ("fx1", "fx2"):
            channels[name] = np.where(missing, np.nan, channels[name])
    sds = [each.width_sd for each in grips]
    touch_sd = float(np.sqrt(np.mean(np.square(sds)))) if sds else 0.0
    touches = tuple(touch for each in grips for touch in _touches(t, opening, each))
    surely = np.ones(t.size)
    for each in grips:
        last = min(each.stop, t.size) - 1
        surely[(t > t[each.start] - SURELY) & (t < t[last] + SURELY)] = 0.0
    wrong = _inertia(t, pose, tool, rig.gripper.turns, rig.gravity)
    timing = _timing(t, pose, np.sqrt(np.maximum(wrong[:, 1] ** 2 - tool.noise**2, 0)), fy, tool.noise)
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


def _timing(t: np.ndarray, pose: Pose, wrong: np.ndarray, load: np.ndarray, noise: float) -> np.ndarray:
    """How uncertain a load [N] that is `wrong` [N] makes the moment of its change (num_timesteps,) [s].

    A load that changes by so much per second is off by that much of its time.
    """
    from scipy.ndimage import maximum_filter1d  # slow to import

    pace = maximum_filter1d(np.abs(np.gradient(np.nan_to_num(load), t)), _around(t, pose))
    return np.minimum(wrong / np.maximum(pace, noise / float(np.median(np.diff(t)))), pose.window / 2)


def _around(t: np.ndarray, pose: Pose) -> int:
    """Samples of the smoothing window, an odd number."""
    return max(3, round(pose.window / float(np.median(np.diff(t)))) // 2 * 2 + 1)


def _strays(trial: Trial, free: np.ndarray, felt: np.ndarray, tool: Tool) -> list[str]:
    """Where the wrist feels something for a while though the opening says that nothing is held."""
    t, out = trial.t, []
    active = free & (np.nan_to_num(felt) > max(2 * ACTIVE * tool.noise, STRAY))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]])))
    for start, stop in edges.reshape(-1, 2):
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
    gripper = rig.gripper
    assert gripper is not None
    if gripper.tool_mass is not None and gripper.sensor_axes is not None and gripper.reaction is not None:
        return ()
    mass = "as given" if gripper.tool_mass else "from free motion"
    text = f"{trial.file}: tool of {tool.mass:.3g} kg on the sensor ({mass})"
    if gripper.sensor_axes is None and gripper.frame == "sensor":
        up = tool.axes @ direction(gripper.up)
        names = gripper.wrench[:3]
        largest = int(np.argmax(np.abs(up)))
        sign = "-" if up[largest] < 0 else ""
        text += f"; a load that hangs on it shows in {sign}{names[largest]}"
    return (text,)
