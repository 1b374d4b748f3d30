"""Commands that reach the drives late."""

from __future__ import annotations

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting, Theta
from simgap.simulators.protocol import Parameter
from simgap.simulators.recording import Recording

TICK = 1e-9  # numerics: s: times that are equal but for rounding

WORDS = {
    "command.delay": ("commands that are carried out late", "Log commands and motion with one clock."),
}


def _late(names: list[str]):
    def late(recording: Recording, theta: Theta) -> Recording:
        at = recording.t - theta["delay"]
        return recording.with_columns({n: np.interp(at, recording.t, recording[n]) for n in names})

    return late


def _late_by_time(names: list[str], acts: str):
    """Of a simulator that is told when each row's commands are carried out: the very ones, as much later."""

    def late(recording: Recording, theta: Theta) -> Recording:
        t, delay = recording.t, theta["delay"]
        row = np.searchsorted(t, t - delay + TICK, side="right") - 1
        begun = row >= 0
        row = np.maximum(row, 0)
        times = {acts: np.where(begun, t[row] + delay, t)}
        return recording.with_columns({n: recording[n][row] for n in names} | times)

    return late


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for all commands together; they hold their first value before the log's start."""
    names = setting.commands()
    if not names:
        return []
    delay = Parameter(0.0, 0.01, "s", low=0.0, high=0.5)
    acts = getattr(setting.simulator, "acts", None)
    late = _late(names) if acts is None else _late_by_time(names, acts)
    return [RobotEffect("command.delay", "acted(t) = commanded(t - delay)", {"delay": delay}, command=late)]
