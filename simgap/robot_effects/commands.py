"""Effects on commands: those of a channel, a delay of all together, and a sagging supply.

Each maps a recording to one with commands as the drives carried them out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from simgap.channels import ChannelEffect, Theta, channel_effects
from simgap.channels.drives import LARGEST
from simgap.effect import Parameter
from simgap.robot_effects.base import Command, RobotEffect, Setting
from simgap.simulators.recording import Recording

TICK = 1e-9  # numerics: s: rounding of equal times

KINDS = ("effort", "duty", "place")  # of commands
WORDS = {
    "command.delay": ("commands that are carried out late", "Log commands and motion with one clock."),
    "command.early": ("commands that are logged late", "Log commands as they are given, not a cycle later."),
    "supply.sag": (
        "torque that falls with the supply's voltage",
        "Measure the voltage at the drive under load.",
    ),
} | {f"command.{n}": (e.called, e.check) for n, e in channel_effects(*KINDS).items()}


def candidates(setting: Setting) -> Iterator[RobotEffect]:
    """One of each kind for every command that it applies to; a delay of all commands together, and a sag for
    every command in V that varies."""
    known, every = setting.simulator.channels, drives(setting)
    of = {"effort": [n for n in every if known[n].unit != "1"],
          "duty": [n for n in every if known[n].unit == "1"], "place": places(setting)}  # fmt: skip
    for effect in channel_effects(*of).values():
        yield from (_of(setting, name, effect) for kind in effect.of for name in of.get(kind, ()))
    names = setting.commands()
    if names:  # all commands hold their first value before the log's start, their last one after its end
        delay = Parameter(0.0, 0.01, "s", low=0.0, high=0.5)
        acts = getattr(setting.simulator, "acts", None)
        late = _late(names) if acts is None else _late_by_time(names, acts)
        yield RobotEffect("command.delay", "acted(t) = commanded(t - delay)", {"delay": delay}, command=late)
        # Not one with the delay, whose bound tells commands held in steps from those on lines.
        early = {"early": replace(delay, high=0.2)}
        yield RobotEffect(
            "command.early", "acted(t) = commanded(t + early)", early,
            command=lambda log, theta: late(log, {"delay": -theta["early"]}),
        )  # fmt: skip
    yield from _sags(setting, every)


def _of(setting: Setting, name: str, effect: ChannelEffect) -> RobotEffect:
    """An effect on one command."""
    more = {LARGEST: setting.largest(name) or 1.0}

    def command(recording: Recording, theta: Theta) -> Recording:
        acted = effect.read(recording.t - recording.t[0], recording[name], {**theta, **more})
        return recording.with_columns({name: acted})

    return RobotEffect(
        f"command:{name}.{effect.name}", effect.says, setting.sized(effect, name), command=command
    )


def _late(names: list[str]) -> Command:
    def late(recording: Recording, theta: Theta) -> Recording:
        at = recording.t - theta["delay"]
        return recording.with_columns({n: np.interp(at, recording.t, recording[n]) for n in names})

    return late


def _late_by_time(names: list[str], acts: str) -> Command:
    """For a simulator that takes the times at which each row's commands are carried out: the same commands,
    later, and with each row those that follow."""

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


def _sagging(names: list[str], supply: str, usual: float) -> Command:
    def act(recording: Recording, theta: Theta) -> Recording:
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
    """Commands of torque, force, current or duty: zero where nothing is to be done."""
    known = setting.simulator.channels
    efforts = {n for n in setting.commands() if known[n].unit in ("N m", "N", "A", "Nm")}
    switches = {n for n in setting.commands() if known[n].unit == "1" and _switches(setting, n)}
    return [n for n in setting.commands() if n in efforts or (known[n].unit == "1" and n not in switches)]


def places(setting: Setting) -> list[str]:
    """Commands of a position."""
    return [n for n in setting.commands() if setting.simulator.channels[n].unit in ("rad", "m", "deg", "mm")]


def _switches(setting: Setting, name: str) -> bool:
    """Whether a command has two values at most, as a switch has."""
    return all(np.unique(r[name][np.isfinite(r[name])]).size <= 2 for r in setting.recordings)
