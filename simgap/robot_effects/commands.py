"""What drives make of commands: late, scaled, offset, clipped, faded, through a dead band or play, or as
strong as the supply is. Each maps a whole recording to one whose commands are as the drives took them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from hmmseg.online.compiled import compiled
from simgap.robot_effects.base import RobotEffect, Setting, Theta
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording

TICK = 1e-9  # numerics: s: times that are equal but for rounding

WORDS = {
    "command.backlash": (
        "play between a drive and what it moves",
        "Hold the drive still and move the joint by hand.",
    ),
    "command.dead_band": (
        "commands too small to do anything",
        "Raise the command slowly from nothing and note where motion begins.",
    ),
    "command.delay": ("commands that are carried out late", "Log commands and motion with one clock."),
    "command.fade": (
        "a drive that falls behind large commands",
        "Command a large constant torque and measure it.",
    ),
    "command.gain": (
        "commands that are carried out too weakly or strongly",
        "Command a known step and measure the motion.",
    ),
    "command.offset": (
        "commands that are carried out with an offset",
        "Command the home position and measure where the robot is.",
    ),
    "command.saturation": (
        "a drive that gives no more than so much",
        "Look up the drive's current limit; command its largest torque and measure it.",
    ),
    "supply.sag": (
        "torque that falls with the supply's voltage",
        "Measure the voltage at the drive under load.",
    ),
}


def candidates(setting: Setting) -> Iterator[RobotEffect]:
    """One of each kind for every command that it can be of; a delay is of all commands together, and a sag
    of every command in V that varies."""
    efforts, targets = drives(setting), places(setting)
    for name in targets:
        width = {"width": setting.usual(name, 0.02, low=0.0)}
        yield _of(name, "backlash", "acted follows commanded through a gap of this width", width,
                  lambda u, p: play(u, p["width"]))  # fmt: skip
    for name in efforts:
        band = {"band": setting.usual(name, 0.03, low=0.0)}
        yield _of(name, "dead_band", "acted = commanded less a band about 0", band,
                  lambda u, p: np.sign(u) * np.maximum(np.abs(u) - p["band"], 0.0))  # fmt: skip
    yield from _delay(setting)
    for name in efforts:
        if (most := setting.largest(name)) > 0:
            fade = {"fade": Parameter(0.0, 0.1, "1", low=-0.9, high=0.9)}
            yield _of(name, "fade", "acted = commanded (1 - fade |commanded| / largest)", fade,
                      lambda u, p, most=most: u * (1 - p["fade"] * np.abs(u) / most))  # fmt: skip
    for name in (*efforts, *targets):
        gain = {"gain": Parameter(0.0, 0.03, "1", low=-0.9)}
        yield _of(name, "gain", "acted = (1 + gain) commanded", gain, lambda u, p: (1 + p["gain"]) * u)
    for name in (*efforts, *targets):
        if setting.simulator.channels[name].unit != "1":
            offset = {"offset": setting.usual(name, 0.03)}
            yield _of(name, "offset", "acted = commanded + offset", offset, lambda u, p: u + p["offset"])
    for name in (*efforts, *targets):
        if (most := setting.largest(name)) > 0:
            lost = {"lost": Parameter(0.0, 0.1, "1", low=0.0, high=0.99)}
            says = "acted = commanded, up to (1 - lost) of the largest commanded"
            yield _of(name, "saturation", says, lost, _clipped(most))
    yield from _sags(setting, efforts)


def _clipped(most: float):
    return lambda values, theta: np.clip(values, -(1 - theta["lost"]) * most, (1 - theta["lost"]) * most)


def _of(
    name: str, what: str, says: str, parameters: dict[str, Parameter],
    act: Callable[[np.ndarray, Theta], np.ndarray],
) -> RobotEffect:  # fmt: skip
    """An effect on one command, sample by sample or along it."""

    def command(recording: Recording, theta: Theta) -> Recording:
        return recording.with_columns({name: act(recording[name], theta)})

    return RobotEffect(f"command:{name}.{what}", says, parameters, command=command)


@compiled
def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only where that pushes a side of the gap."""
    out = np.empty_like(values)
    at = values[0]
    for i in range(values.size):
        if np.isfinite(values[i]):
            at = min(max(at, values[i] - width / 2), values[i] + width / 2)
        out[i] = at
    return out


def _late(names: list[str]):
    def late(recording: Recording, theta: Theta) -> Recording:
        at = recording.t - theta["delay"]
        return recording.with_columns({n: np.interp(at, recording.t, recording[n]) for n in names})

    return late


def _late_by_time(names: list[str], acts: str):
    """Of a simulator that is told when each row's commands are carried out: the very ones, as much later,
    and with each row those that follow."""

    def late(recording: Recording, theta: Theta) -> Recording:
        delay, given = theta["delay"], recording.columns.get(acts, recording.t)
        row = np.searchsorted(given, recording.t - delay + TICK, side="right") - 1
        begun = row >= 0
        row = np.maximum(row, 0)
        after = np.minimum(row + begun, len(given) - 1)
        times = {acts: np.where(begun, given[row] + delay, recording.t), f"{acts}next": given[after] + delay}
        following = {f"{acts}{n}": recording[n][after] for n in names}
        return recording.with_columns({n: recording[n][row] for n in names} | times | following)

    return late


def _delay(setting: Setting) -> list[RobotEffect]:
    """All commands hold their first value before the log's start."""
    names = setting.commands()
    if not names:
        return []
    delay = Parameter(0.0, 0.01, "s", low=0.0, high=0.5)
    acts = getattr(setting.simulator, "acts", None)
    late = _late(names) if acts is None else _late_by_time(names, acts)
    return [RobotEffect("command.delay", "acted(t) = commanded(t - delay)", {"delay": delay}, command=late)]


def _sagging(names: list[str], supply: str, usual: float):
    def act(recording, theta):
        scale = 1 + theta["share"] * (recording[supply] / usual - 1)
        return recording.with_columns({n: scale * recording[n] for n in names})

    return act


def _sags(setting: Setting, efforts: list[str]) -> Iterator[RobotEffect]:
    for supply in setting.commands():
        values = np.concatenate([r[supply] for r in setting.recordings])
        if setting.simulator.channels[supply].unit != "V" or not efforts or np.nanstd(values) == 0:
            continue
        usual = float(np.nanmedian(values))
        share = {"share": Parameter(0.0, 0.3, "1", low=-3.0, high=6.0)}
        act = _sagging([n for n in efforts if n != supply], supply, usual)
        says = "torque follows the supply's voltage by this share"
        yield RobotEffect(f"supply:{supply}.sag", says, share, command=act)


def drives(setting: Setting) -> list[str]:
    """Commands of torque, force, current or duty: those that are 0 where nothing is to be done."""
    known = setting.simulator.channels
    efforts = {n for n in setting.commands() if known[n].unit in ("N m", "N", "A", "Nm")}
    switches = {n for n in setting.commands() if known[n].unit == "1" and _switches(setting, n)}
    return [n for n in setting.commands() if n in efforts or (known[n].unit == "1" and n not in switches)]


def places(setting: Setting) -> list[str]:
    """Commands of a position."""
    return [n for n in setting.commands() if setting.simulator.channels[n].unit in ("rad", "m", "deg", "mm")]


def _switches(setting: Setting, name: str) -> bool:
    """Whether a command has two values at most: a switch, not a drive."""
    return all(np.unique(r[name][np.isfinite(r[name])]).size <= 2 for r in setting.recordings)
