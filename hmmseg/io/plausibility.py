"""What a recording cannot be: times, lengths and angles in other units than stated.

Recognised by what a hand can do: it is sampled from a few Hz to some 20 kHz, travels less than
3 m, its links do not wind twice around, and its velocities are the derivatives of its positions.
Nothing is guessed: a finding says in one line what to write into `rig.toml`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.columns import Column
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.trial import Trial

SLOWEST = 2.0  # limit: [Hz]; hands are recorded at 10 Hz at least
FASTEST = 2e4  # limit: [Hz]; of what a hand's or a robot's sensors are read at
ANY_FASTEST = 1e7  # limit: [Hz]; of any recording of things that move
REACH = 3.0  # limit: [m]
WEAKEST, STRONGEST = 0.02, 1000.0  # limit: [N] of a grip
STILL = 2e-4  # limit: [m]: travel of a hand that moved nothing
WINDING = 4 * np.pi  # [rad]
YEAR_1990, YEAR_2100 = 6.3e8, 4.1e9  # physics: [s] since 1970
SAME = 0.15  # limit: relative: a factor of 1000 or 57.3 is told apart from 1 by far more


@dataclass(frozen=True)
class Finding:
    """Something that cannot be (`certain`, refused) or is unlikely, and the mapping that mends it.

    `changes` holds by channel the fields of its entry in `[columns]` (or `[topics]`).
    """

    channel: str
    problem: str
    changes: dict[str, dict[str, Any]]
    certain: bool = True
    table: str = "columns"

    @property
    def remedy(self) -> str:
        """What to write where, in a line."""
        entries = ", ".join(entry_text(name, fields) for name, fields in self.changes.items())
        return f"{entries} under [{self.table}] in rig.toml"


def entry_text(channel: str, fields: dict[str, Any]) -> str:
    """An entry of `[columns]` as TOML."""
    quoted = (f"{key} = {json.dumps(value)}" for key, value in fields.items())
    return f"{json.dumps(channel) if not channel.isidentifier() else channel} = {{{', '.join(quoted)}}}"


def exchanged(
    stems: tuple[str, ...], pair: tuple[str, str], trial: Trial, rig: Rig | None
) -> dict[str, dict[str, Any]]:
    """Each channel of one of a pair (of fingers, of axes) from where the other's comes from now.

    `stems` are the channels' names with {} for what the pair names.
    """
    out: dict[str, dict[str, Any]] = {}
    for stem in stems:
        for ours, theirs in (pair, pair[::-1]):
            name, other = stem.format(ours), stem.format(theirs)
            if name in trial.channels and other in trial.channels:
                out[name] = changed(other, rig)[other]
    return out


def changed(channel: str, rig: Rig | None, **change: Any) -> dict[str, dict[str, Any]]:
    """The entry of a channel with this change: what the rig already says of it is kept."""
    now = Column() if rig is None else (rig.columns | rig.topics).get(channel, Column())
    fields: dict[str, Any] = {"from": now.source or channel}
    unit, sign = change.get("unit", now.unit), now.sign * change.get("sign", 1)
    offset = now.offset + change.get("offset", 0.0)
    fields |= {} if unit is None else {"unit": unit}
    fields |= {} if sign == 1 else {"sign": int(sign)}
    fields |= {} if offset == 0 else {"offset": offset}
    return {channel: fields}


def all_changed(channels: Iterable[str], rig: Rig | None, **change: Any) -> dict[str, dict[str, Any]]:
    """The same change for several channels."""
    return {name: fields for each in channels for name, fields in changed(each, rig, **change).items()}


def check_clock(trial: Trial, rig: Rig | None, moving: bool = True) -> list[Finding]:
    """Times in ms, us or ns: by `rate` of the rig, by a date, or because no hand is sampled so slowly.

    `moving`: of a hand or a robot; other recordings may be slow, and are warned of where times are whole.
    """
    period = float(np.median(np.diff(trial.t)))
    stated = None if rig is None else rig.rate
    unit, certain = None, True
    for name, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if stated is not None and 0.5 < period * size * stated < 2:
            unit = name
        if YEAR_1990 < trial.t[0] * size < YEAR_2100:
            unit = name
    if unit is None and period > 1 / SLOWEST:
        unit = "ms" if period < 500 else "us" if period < 5e5 else "ns"
        certain = moving
        if not moving and (trial.t != np.round(trial.t)).any():
            unit = None
    if unit is None and 1 / period > (FASTEST if moving else ANY_FASTEST):
        problem = f"is sampled at {1 / period:.2g} Hz if it is in s, and nothing moves so fast"
        size = 1e3 ** np.ceil(np.log(1 / FASTEST / period) / np.log(1e3))
        return [Finding("t", problem, changed("t", rig, unit=float(size)))]
    if unit is not None:
        problem = f"is sampled at {1 / period:.2g} Hz if it is in s"
        if stated is not None:
            problem += f", but rate = {stated:g} in rig.toml"
        return [Finding("t", f"{problem}: it looks like {unit}", changed("t", rig, unit=unit), certain)]
    found = []
    if stated is not None and abs(np.log(period * stated)) > SAME:
        problem = f"is sampled at {1 / period:.4g} Hz, but rate = {stated:g} in rig.toml, which is not used"
        found.append(Finding("t", problem, {}, certain=False))
    if moving and YEAR_1990 < trial.t[0] < YEAR_2100:
        date = np.datetime64(int(trial.t[0]), "s")
        problem = f"counts seconds since 1970 (from {date}), and so will all results"
        change = changed("t", rig, offset=-float(np.floor(trial.t[0])))
        found.append(Finding("t", problem, change, certain=False))
    return found


def judged(trial: Trial, findings: Iterable[Finding]) -> tuple[str, ...]:
    """Warnings about a trial; InputError for what cannot be."""
    warnings = []
    for finding in findings:
        where = f"{trial.file}: column {finding.channel}"
        if finding.certain:
            raise InputError(where, finding.problem, finding.remedy)
        remedy = f"; expected {finding.remedy}" if finding.changes else ""
        warnings.append(f"{where} {finding.problem}{remedy}")
    return tuple(warnings)


def check_lengths(trial: Trial, rig: Rig | None) -> list[Finding]:
    """Positions in mm or cm (no hand travels so far), or far too small."""
    travels = {
        name: float(np.nanmax(values) - np.nanmin(values))
        for name, values in trial.channels.items()
        if name in ("x1", "y1", "x2", "y2") and np.isfinite(values).any()
    }  # fmt: skip
    far = {name: travel for name, travel in travels.items() if travel > REACH}
    if far:
        name, travel = max(far.items(), key=lambda item: item[1])
        unit, text = length_unit(travel)
        problem = f"travels {travel:.4g} m, a hand less than {REACH:g} m: it looks like {text}"
        return [Finding(name, problem, all_changed(far, rig, unit=unit))]
    if travels and max(travels.values()) < STILL:
        problem = f"travels {max(travels.values()):.2g} m in all: positions look as if they were in km"
        return [Finding("x1", problem, all_changed(travels, rig, unit="mm"), certain=False)]
    return []


def length_unit(travel: float) -> tuple[str, str]:
    """The likeliest unit of positions that travel so many units, and that with the next likely one."""
    if travel < 30:
        return "cm", 'cm (or "in")'
    if travel < 100:
        return "mm", 'mm (or "cm")'
    return ("mm", "mm") if travel < 5e3 else ("um", "um")


def check_angles(trial: Trial, rig: Rig | None) -> list[Finding]:
    """Joint angles in degrees: no link winds twice around."""
    named = [name for name in ("q11", "q12", "q21", "q22") if name in trial.channels]
    joints = [name for name in named if np.isfinite(trial.channels[name]).any()]
    widest = {name: float(np.nanmax(np.abs(trial.channels[name]))) for name in joints}
    wound = {name: value for name, value in widest.items() if value > WINDING}
    if not wound:
        return []
    name, value = max(wound.items(), key=lambda item: item[1])
    unit = "deg" if value < 3600 else "mrad"
    changes = all_changed(joints, rig, unit=unit)
    as_they = [f"d{each}" for each in joints if abs(scale_to_velocity(trial, each, f"d{each}") - 1) < SAME]
    changes |= all_changed(as_they, rig, unit=f"{unit}/s")
    problem = f"reaches {value:.4g} rad, {value / 2 / np.pi:.0f} turns of a link: it looks like {unit}"
    return [Finding(name, problem, changes)]


def check_velocities(trial: Trial, rig: Rig | None) -> list[Finding]:
    """Velocities that are the positions' derivatives times a factor of units, or with the other sign."""
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
    changes = {k: v for each, (_, what) in found.items() for k, v in changed(each, rig, **what).items()}
    text = f"is {slope:.3g} times what {name.removeprefix('d').removeprefix('v')} changes by"
    return [Finding(name, text, changes)]


def check_forces(trial: Trial, rig: Rig | None) -> list[Finding]:
    """Forces in mN or kN: no fingertip presses so hard, or holds anything so softly."""
    names = [name for name in FORCE_CHANNELS if name in trial.channels]
    there = [np.abs(v[np.isfinite(v)]) for v in (trial.channels[name] for name in names)]
    strongest = max((float(np.quantile(v, 0.99)) for v in there if v.size), default=1.0)
    if WEAKEST < strongest < STRONGEST or strongest == 0:
        return []
    unit = "mN" if strongest > 1 else "kN"
    problem = f"reaches {strongest:.3g} N, a fingertip {WEAKEST:g} to {STRONGEST:g} N: it looks like {unit}"
    return [Finding(names[0], problem, all_changed(names, rig, unit=unit), certain=False)]


def position_pairs(trial: Trial) -> list[tuple[str, str]]:
    """Names of each position with its velocity, where both are recorded."""
    named = [(f"q{i}{j}", f"dq{i}{j}") for i in "12" for j in "12"]
    named += [(f"{axis}{i}", f"v{axis}{i}") for i in "12" for axis in "xy"]
    return [pair for pair in named if all(name in trial.channels for name in pair)]


def scale_to_velocity(trial: Trial, position: str, velocity: str) -> float:
    """What integrated velocity is to displacement over windows in which the hand moves; nan if unclear.

    Windows make noise small beside displacement, as a difference of neighbours does not.
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
