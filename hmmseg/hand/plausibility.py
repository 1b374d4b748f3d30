"""Checks of a recording against the abilities of a hand, each with the line of `rig.toml` that mends it.

A hand is sampled at a few Hz to some 20 kHz, travels less than 3 m, its links do not wind twice around, and
its velocities are the derivatives of its positions. Fingers that hold something press towards each other,
finger 1 from the left, and what is lifted weighs on them. Forces are exerted by the fingertip on the block,
so that a grip has fx1 > 0 and fx2 < 0, and a carry fy1 + fy2 > 0. Nothing is corrected without the user's
consent.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Rig
from hmmseg.io.trial import Trial, position_pairs
from hmmseg.io.units import UNITS, Column
from hmmseg.levels import SURE
from hmmseg.robust import extent, runs, white_sd

SLOWEST = 2.0  # limit: [Hz]; hands are recorded at 10 Hz at least
FASTEST = 2e4  # limit: [Hz]; sampling rate of a hand's or a robot's sensors
ANY_FASTEST = 1e7  # limit: [Hz]; sampling rate of any recording of motion
REACH = 3.0  # limit: [m]
WEAKEST, STRONGEST = 0.02, 1000.0  # limit: [N] of a grip
STILL = 2e-4  # limit: [m]; a hand that travels less moved nothing
WINDING = 4 * np.pi  # [rad]
YEAR_1990, YEAR_2100 = 6.3e8, 4.1e9  # physics: [s] since 1970
SAME = 0.15  # limit: relative; factors of 1000 or 57.3 differ from 1 by far more


@dataclass(frozen=True)
class Finding:
    """Something impossible (`certain`, refused) or unlikely, and the mapping that mends it.

    `changes`: by channel, the fields of its entry in `[columns]` (or `[topics]`).
    """

    channel: str
    problem: str
    changes: dict[str, dict[str, Any]]
    certain: bool = True
    table: str = "columns"

    @property
    def remedy(self) -> str:
        """The entries to write, and where, in one line."""
        entries = ", ".join(entry_text(name, fields) for name, fields in self.changes.items())
        return f"{entries} under [{self.table}] in rig.toml"


def entry_text(channel: str, fields: dict[str, Any]) -> str:
    """An entry of `[columns]` as TOML."""
    quoted = (f"{key} = {json.dumps(value)}" for key, value in fields.items())
    return f"{json.dumps(channel) if not channel.isidentifier() else channel} = {{{', '.join(quoted)}}}"


def exchanged(
    stems: tuple[str, ...], pair: tuple[str, str], trial: Trial, rig: Rig
) -> dict[str, dict[str, Any]]:
    """Entries that exchange the sources of a pair of fingers or axes.

    `stems` are the channels' names with {} for what the `pair` names.
    """
    pairs = [(stem.format(a), stem.format(b)) for stem in stems for a, b in (pair, pair[::-1])]
    there = trial.channels.keys()
    return {ours: changed([theirs], rig)[theirs] for ours, theirs in pairs if {ours, theirs} <= there}


def changed(channels: Iterable[str], rig: Rig | None, **change: Any) -> dict[str, dict[str, Any]]:
    """Entries of channels with a change of `unit`, `sign` or `offset` [SI] of what the rig says."""
    out = {}
    for channel in channels:
        now = Column() if rig is None else (rig.columns | rig.topics).get(channel, Column())
        unit, sign = change.get("unit", now.unit), now.sign * change.get("sign", 1)
        offset = now.offset + change.get("offset", 0.0)
        fields = {"from": now.source or channel, "unit": unit, "sign": int(sign), "offset": offset}
        usual = {"unit": None, "sign": 1, "offset": 0}
        out[channel] = {key: v for key, v in fields.items() if key not in usual or v != usual[key]}
    return out


def check_clock(trial: Trial, rig: Rig | None, moving: bool = True) -> list[Finding]:
    """Times in ms, us or ns: by the rig's `rate`, by a date, or because no hand is sampled so slowly.

    `moving`: whether it is a hand or a robot; other recordings may be slow, and only whole times are odd.
    """
    period = float(np.median(np.diff(trial.t)))
    stated = None if rig is None else rig.rate
    unit, certain = None, True
    for name, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        as_stated = stated is not None and 0.5 < period * size * stated < 2
        if as_stated or YEAR_1990 < trial.t[0] * size < YEAR_2100:
            unit = name
    if unit is None and period > 1 / SLOWEST:
        unit = "ms" if period < 500 else "us" if period < 5e5 else "ns"
        certain = moving
        if not moving and (trial.t != np.round(trial.t)).any():
            unit = None
    if unit is None and 1 / period > (FASTEST if moving else ANY_FASTEST):
        problem = f"is sampled at {1 / period:.2g} Hz if it is in s, and nothing moves so fast"
        size = 1e3 ** np.ceil(np.log(1 / FASTEST / period) / np.log(1e3))
        return [Finding("t", problem, changed(["t"], rig, unit=float(size)))]
    if unit is not None:
        problem = f"is sampled at {1 / period:.2g} Hz if it is in s"
        if stated is not None:
            problem += f", but rate = {stated:g} in rig.toml"
        return [Finding("t", f"{problem}: it looks like {unit}", changed(["t"], rig, unit=unit), certain)]
    found = []
    if stated is not None and abs(np.log(period * stated)) > SAME:
        problem = f"is sampled at {1 / period:.4g} Hz, but rate = {stated:g} in rig.toml, which is not used"
        found.append(Finding("t", problem, {}, certain=False))
    if moving and YEAR_1990 < trial.t[0] < YEAR_2100:
        date = np.datetime64(int(trial.t[0]), "s")
        problem = f"counts seconds since 1970 (from {date}), and so will all results"
        change = changed(["t"], rig, offset=-float(np.floor(trial.t[0])))
        found.append(Finding("t", problem, change, certain=False))
    return found


def judge(trial: Trial, findings: Iterable[Finding]) -> tuple[str, ...]:
    """Warnings about a trial; InputError for the first certain finding."""
    warnings = []
    for finding in findings:
        where = f"{trial.file}: column {finding.channel}"
        if finding.certain:
            raise InputError(where, finding.problem, finding.remedy)
        remedy = f"; expected {finding.remedy}" if finding.changes else ""
        warnings.append(f"{where} {finding.problem}{remedy}")
    return tuple(warnings)


def check_lengths(trial: Trial, rig: Rig) -> list[Finding]:
    """Positions in mm or cm (no hand travels so far), or in km."""
    gripper = rig.gripper
    names = ("x1", "y1", "x2", "y2") if gripper is None else gripper.position.values()
    travels = {name: extent(values) for name, values in trial.channels.items()
               if name in names and np.isfinite(values).any()}  # fmt: skip
    name, travel = max(travels.items(), key=lambda item: item[1], default=("", 0.0))
    if travel > REACH:
        unit, text = "mm", "mm"
        if travel < 100:
            unit, text = ("cm", 'cm (or "mm" or "in")') if travel < 30 else ("mm", 'mm (or "cm")')
        elif travel >= 5e3:
            unit, text = "um", "um"
        problem = f"travels {travel:.4g} m, a hand less than {REACH:g} m: it looks like {text}"
        near = travel * UNITS[unit][1] ** 0.5  # what travels less is in m; a gripper has one unit
        mended = [n for n, each in travels.items() if each > near or gripper is not None]
        return [Finding(name, problem, changed(mended, rig, unit=unit))]
    noise = max((_noise(trial.channels[n]) for n in travels), default=0.0)
    if 2 * SURE * noise < travel < STILL:  # less is a hand that stands still
        name = next(iter(travels))
        problem = f"travels {travel:.2g} m in all: positions look as if they were in km"
        return [Finding(name, problem, changed(travels, rig, unit="mm"), certain=False)]
    return []


def check_angles(trial: Trial, rig: Rig) -> list[Finding]:
    """Joint angles in degrees: no link winds twice around."""
    joints = [name for name in JOINTS if np.isfinite(trial.channels.get(name, np.nan)).any()]
    widest = {name: float(np.nanmax(np.abs(trial.channels[name]))) for name in joints}
    wound = {name: value for name, value in widest.items() if value > WINDING}
    if not wound:
        return []
    name, value = max(wound.items(), key=lambda item: item[1])
    unit = "deg" if value < 3600 else "mrad"
    changes = changed(joints, rig, unit=unit)
    right = [f"d{each}" for each in joints if abs(scale_to_velocity(trial, each, f"d{each}") - 1) < SAME]
    changes |= changed(right, rig, unit=f"{unit}/s")  # rates that go with the angles are in degrees too
    problem = f"reaches {value:.4g} rad, {value / 2 / np.pi:.0f} turns of a link: it looks like {unit}"
    return [Finding(name, problem, changes)]


def check_velocities(trial: Trial, rig: Rig) -> list[Finding]:
    """Velocities that are the positions' derivatives times a factor of units, or of the other sign."""
    factors = {"q": ((180 / np.pi, "deg/s"), (1e3, "mrad/s")), "x": ((1e3, "mm/s"), (1e2, "cm/s"))}
    found: dict[str, tuple[float, dict[str, object]]] = {}
    for position, velocity in position_pairs(trial):
        slope = scale_to_velocity(trial, position, velocity)
        for factor, unit in factors["q" if position[0] == "q" else "x"]:
            if abs(slope / factor - 1) < SAME:
                found[velocity] = slope, {"unit": unit}
        if abs(slope + 1) < SAME:
            found[velocity] = slope, {"sign": -1}
    if not found:
        return []
    name, (slope, _) = next(iter(found.items()))
    changes = {k: v for each, (_, what) in found.items() for k, v in changed([each], rig, **what).items()}
    text = f"is {slope:.3g} times what {name.removeprefix('d').removeprefix('v')} changes by"
    return [Finding(name, text, changes)]


def check_forces(trial: Trial, rig: Rig) -> list[Finding]:
    """Forces in mN or kN: no fingertip presses so hard, or holds anything so softly."""
    names = [name for name in FORCE_CHANNELS if name in trial.channels]
    there = [np.abs(v[np.isfinite(v)]) for v in (trial.channels[name] for name in names)]
    strongest = max((float(np.quantile(v, 0.99)) for v in there if v.size), default=1.0)
    if WEAKEST < strongest < STRONGEST or strongest == 0:
        return []
    unit = "mN" if strongest > 1 else "kN"
    problem = f"reaches {strongest:.3g} N, a fingertip {WEAKEST:g} to {STRONGEST:g} N: it looks like {unit}"
    return [Finding(names[0], problem, changed(names, rig, unit=unit), certain=False)]


def scale_to_velocity(trial: Trial, position: str, velocity: str) -> float:
    """Slope of integrated velocity over displacement, across windows in which the hand moves; NaN if unclear.

    Windows make noise small against displacement; differences of neighbouring samples would not.
    """
    q, v, t = trial.channels[position], trial.channels[velocity], trial.t
    there = np.isfinite(q) & np.isfinite(v)
    q, v, t = q[there], v[there], t[there]
    if t.size < 20:
        return np.nan
    width = max(2, t.size // 50)
    integral = np.concatenate([[0.0], np.cumsum(np.diff(t) * (v[1:] + v[:-1]) / 2)])
    moved, swept = q[width:] - q[:-width], integral[width:] - integral[:-width]
    far = np.abs(moved) >= np.quantile(np.abs(moved), 0.8)
    moved, swept = moved[far], swept[far]
    noise = 1.5 * np.median(np.abs(np.diff(q)))
    norm = float(np.sqrt((moved**2).sum() * (swept**2).sum()))
    if norm == 0 or np.median(np.abs(moved)) < 5 * noise / np.sqrt(width):
        return np.nan
    if abs(float((moved * swept).sum())) < 0.9 * norm:
        return np.nan
    return float((moved * swept).sum() / (moved**2).sum())


MORE = 3.0  # limit: a grip exceeds what pads share unequally of a load by this factor
CARTESIAN = ("{}1", "{}2", "v{}1", "v{}2")
FORCES = ("f{}1", "f{}2")


def check_axes(trial: Trial, rig: Rig) -> list[Finding]:
    """Fingers that press against each other, or stand apart, along y in place of x."""
    s = task_space(trial, rig)
    pressed = _strong(np.fmax(np.abs(s.fx1), np.abs(s.fx2))), _strong(s.fy1 - s.fy2)  # for any signs of fx
    noise = max(_noise(s.fy1), _noise(s.fy2))
    forces = bool(pressed[1] > max(MORE * pressed[0], 20 * noise))
    gripping = np.abs(s.fy1 - s.fy2 if forces else s.fx1) > pressed[forces] / 2
    places = False
    if not rig.jointed and gripping.any():
        apart = [abs(float(np.nanmedian(v[gripping]))) if np.isfinite(v[gripping]).any() else np.nan
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
    """Magnitude of a difference of forces (num_timesteps,) [N] in a grip: its 95 % quantile."""
    there = np.abs(difference[np.isfinite(difference)])
    return float(np.quantile(there, 0.95)) if there.size else 0.0


def _noise(values: np.ndarray) -> float:
    there = values[np.isfinite(values)]
    return white_sd(there, 1) if there.size > 1 else 0.0


ALL = 0.95  # limit: share of the samples that must agree
MOST = 0.75  # limit: the same where a hold continues after its block has been put down
LIFTED = 0.005  # limit: [m]
CARTESIAN_STEMS = ("x{}", "y{}", "vx{}", "vy{}", "fx{}", "fy{}")
JOINT_STEMS = ("q{}1", "q{}2", "dq{}1", "dq{}2", "fx{}", "fy{}")
BRIEF = 5  # limit: samples; a shorter touch is no hold


@dataclass(frozen=True)
class Holds:
    """When the fingers press.

    Attributes:
        pressed: samples (num_timesteps,) of all holds.
        height: (num_timesteps,) [m] above the first sample of the hold.
        free: samples (num_timesteps,) of at most a light touch.
        rises: for each hold in which the hand moves, whether it goes up first.
    """

    pressed: np.ndarray
    height: np.ndarray
    free: np.ndarray
    rises: tuple[bool, ...]


def check_signs(trial: Trial, rig: Rig) -> list[Finding]:
    """Swapped fingers, flipped signs, and loads that are no block's weight."""
    s = task_space(trial, rig)
    there = np.isfinite([s.fx1 - s.fx2, s.distance, s.y, s.fy]).all(axis=0)
    if there.sum() < 4 * BRIEF:
        return []
    some: dict[str, Any] = {name: v[there] for name, v in vars(s).items() if isinstance(v, np.ndarray)}
    s = replace(s, **some)
    squeeze, load = (s.fx1 - s.fx2) / 2, s.fy
    same = _pushing_alike((s.fx1 + s.fx2) / 2, squeeze, load)
    if same is not None:
        name = "fx2" if same > 0 else "fx1"
        problem = "fx1 and fx2 push the same way all along, a grip pushes from both sides"
        return [Finding(name, problem, changed([name], rig, sign=-1))]
    holds = find_holds(squeeze, s.y)
    if holds is None:
        return []
    apart, towards = _agreed(s.distance[holds.pressed]), _agreed(squeeze[holds.pressed])
    lifts = holds.pressed & (holds.height > LIFTED)
    zero = _zero(load, holds.free)
    idle, added = float(zero[0]), (load - zero)[lifts]
    carried = _agreed(added, MOST) if lifts.sum() >= BRIEF else 0
    first, second = (float(np.median(f[lifts])) if lifts.sum() >= BRIEF else 0.0 for f in (s.fy1, s.fy2))
    found = _sides(apart, towards, carried, first * second > 0, trial, rig)
    found = found or _one_bears(first, second, idle, rig)
    found = found or _downwards(holds, load, trial, rig)
    if found or lifts.sum() < BRIEF:
        return found
    grip = float(np.median(np.abs(squeeze[holds.pressed])))
    return _own_weight(idle, float(np.median(added)), grip, rig)


def _sides(apart: int, towards: int, carried: int, both_bear: bool, trial: Trial, rig: Rig) -> list[Finding]:
    """Judge the signs of x2 - x1 and fx1 - fx2 in holds, of the load and of fy1 fy2 in lifts (0: unclear)."""
    if apart < 0 and towards < 0:
        problem = "finger 1 holds from the right, finger 2 from the left: the fingers are swapped"
        stems = JOINT_STEMS if rig.jointed else CARTESIAN_STEMS
        return [Finding("x1", problem, exchanged(stems, ("1", "2"), trial, rig))]
    if apart > 0 and towards < 0:
        names, problem = ("fx1", "fx2"), "is negative and fx2 positive in a grip: their signs are flipped"
        if carried < 0:
            names = FORCE_CHANNELS
            problem = "is negative in a grip and fy1 + fy2 in a lift: forces on the finger, not by it"
        return [Finding("fx1", problem, changed(names, rig, sign=-1))]
    if apart < 0 and towards > 0 and not rig.jointed:
        problem = "is right of x2 in a grip, but fx1 pushes to the right: positions swapped or x flipped"
        moved = [name for name in ("x1", "vx1", "x2", "vx2") if name in trial.channels]
        return [Finding("x1", problem, changed(moved, rig, sign=-1))]
    if apart > 0 and towards > 0 and carried < 0 and both_bear:
        problem = "and fy2 are negative in sum while a block is lifted: their signs are flipped"
        return [Finding("fy1", problem, changed(("fy1", "fy2"), rig, sign=-1))]
    return []


def _one_bears(first: float, second: float, idle: float, rig: Rig) -> list[Finding]:
    """One finger's load [N] in lifts cancels the other's: one sign is flipped."""
    if first * second >= 0 or abs(first + second - idle) > 0.2 * abs(first - second):
        return []
    name = "fy1" if first < 0 else "fy2"
    problem = f"pulls down with {abs(min(first, second)):.3g} N in lifts while the other finger bears as much"
    return [Finding(name, problem, changed([name], rig, sign=-1), certain=False)]


def _downwards(holds: Holds, load: np.ndarray, trial: Trial, rig: Rig) -> list[Finding]:
    """All holds go down first, through the support of the block: y points down."""
    if any(holds.rises) or not holds.rises or rig.jointed:
        return []
    low = holds.pressed & (holds.height < -LIFTED)
    axes = ["y1", "y2"] if float(np.median(load[low])) > 0 else ["y1", "y2", "fy1", "fy2"]
    axes += [name for name in ("vy1", "vy2") if name in trial.channels]
    problem = "every hold first goes down from where it began, through its block's support: y points down"
    return [Finding("y1", problem, changed(axes, rig, sign=-1), certain=False)]


def _own_weight(idle: float, lifted: float, grip: float, rig: Rig) -> list[Finding]:
    """The load in free motion [N] exceeds what a lift adds: the hand's own weight, or forces not zeroed.

    A smaller one is a bias, which is estimated.
    """
    if abs(idle) < max(abs(lifted), 0.1 * grip):
        return []
    problem = f"and fy2 sum to {idle:.3g} N before the first touch, a lift adds {lifted:.3g} N"
    changes = changed(("fy1", "fy2"), rig, offset=round(-idle / 2, 4))
    problem += ": gravity or an offset is still in the forces"
    return [Finding("fy1", problem, changes, certain=False)]


def find_holds(squeeze: np.ndarray, y: np.ndarray) -> Holds | None:
    """Runs of samples with at least half the usual grip; None if nothing is ever held."""
    scale = float(np.quantile(np.abs(squeeze), 0.95))
    noise = white_sd(squeeze, 1)
    if scale == 0 or scale < 10 * noise:
        return None
    height, rises = np.zeros(y.size), []
    kept = np.zeros(y.size, dtype=bool)
    for start, end in runs(np.abs(squeeze) > scale / 2):
        if end - start >= BRIEF:
            kept[start:end] = True
            height[start:end] = y[start:end] - y[start]
            moved = height[start:end][np.abs(height[start:end]) > LIFTED]
            rises += [bool(moved[0] > 0)] if moved.size else []
    if not kept.any():
        return None
    return Holds(kept, height, np.abs(squeeze) <= scale / 10, tuple(rises))


def _zero(load: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Load [N] read of nothing (num_timesteps,), on lines between free stretches, as zeros drift."""
    each = [((i + j) / 2, np.median(load[i:j])) for i, j in runs(free) if j - i >= BRIEF]
    return np.interp(np.arange(load.size), *np.transpose(each)) if each else np.zeros(load.size)


def _pushing_alike(common: np.ndarray, squeeze: np.ndarray, load: np.ndarray) -> int | None:
    """Sign of both fx where they push the same way as strongly and as long as a grip would, or None."""
    scale = float(np.quantile(np.abs(common), 0.95))
    noise = white_sd(common, 1)
    strong = np.abs(common) > scale / 2
    if scale < max(10 * noise, 3 * float(np.quantile(np.abs(squeeze), 0.95))):
        return None
    if scale < 0.25 * float(np.quantile(np.abs(load), 0.95)) or not 0.1 < strong.mean() < ALL:
        return None  # too weak to hold, a mere touch, or no beginning and end
    return _agreed(common[strong]) or None


def _agreed(values: np.ndarray, share: float = ALL) -> int:
    """The sign of at least `share` of the samples, 0 where they disagree."""
    positive = float((values > 0).mean())
    return 1 if positive >= share else -1 if positive <= 1 - share else 0
