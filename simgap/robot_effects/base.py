"""Effects on a robot, composed around a simulator and never inside of it.

An effect acts on what is read (`alter`), on what is commanded (`command`), or on parameters that the
simulator itself offers (`model`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simgap.channels import ChannelEffect, Theta
from simgap.effect import Effect, Parameter
from simgap.simulators.protocol import Channels, Simulator
from simgap.simulators.recording import Recording

NORMAL_90 = 1.645  # physics: standard deviations that a normal distribution's 90 % interval reaches

Command = Callable[[Recording, Theta], Recording]
Alter = Callable[[Recording, Channels, Theta], Channels]  # (window, channels as read so far, theta)


@dataclass(frozen=True)
class RobotEffect(Effect):
    """One candidate; its `parameters` by short name are neutral at their nominal values.

    `alter` returns the channels of a window that are read differently; `restore` undoes that on a whole log,
    from which starts are then read; `command` maps a recording to one with commands as the drives carried
    them out; `model` maps short names to the simulator's parameters. What is `fitted` is fitted along with
    every cause and is none itself; `widened`: how many usual sizes the sd of its parameters is, where a model
    states them and nobody measured; `by_log`: each log has parameters of its own; `numeric`: it is of the
    simulator's own numerics (its step, how it holds commands), and `dear` where that costs another run of
    every window.
    """

    alter: Alter | None = None
    restore: Command | None = None
    command: Command | None = None
    model: Mapping[str, str] = field(default_factory=dict)
    fitted: bool = False
    widened: float = 0.0
    by_log: bool = False
    numeric: bool = False
    dear: bool = False

    def label(self, short: str) -> str:
        """A parameter's name: the effect's, followed by its own where there are several."""
        return self.name if len(self.parameters) == 1 else f"{self.name}.{short}"


def entry(parameter: Parameter, mean: float, sd: float) -> dict[str, Any]:
    """A parameter's posterior in the document, its interval within bounds."""
    low, high = max(mean - NORMAL_90 * sd, parameter.low), min(mean + NORMAL_90 * sd, parameter.high)
    return {
        "nominal": parameter.nominal, "mean": mean, "sd": sd, "interval_90": [low, high],
        "unit": parameter.unit,
    }  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """What candidates are made for: the simulator and the recordings."""

    simulator: Simulator
    recordings: Sequence[Recording]

    def compared(self, *kinds: str) -> list[str]:
        """Compared channels of these kinds; of all kinds but commands by default."""
        known = self.simulator.channels
        return [n for n, c in known.items() if (c.kind in kinds if kinds else c.kind != "command")]

    def commands(self) -> list[str]:
        """Command channels."""
        return self.compared("command")

    def poses(self) -> Mapping[str, Mapping[str, str]]:
        """Columns of bodies whose whole pose is read, by x, y, z, qw, qx, qy, qz."""
        return getattr(self.simulator, "poses", {})

    def alone(self) -> list[str]:
        """Compared channels but components of a quaternion."""
        turns = {c for columns in self.poses().values() for axis, c in columns.items() if axis[0] == "q"}
        return [n for n in self.compared() if n not in turns]

    def late_alone(self) -> list[str]:
        """Compared channels but components of a pose, which are late together."""
        posed = {c for columns in self.poses().values() for c in columns.values()}
        return [n for n in self.compared() if n not in posed]

    def sized(self, effect: ChannelEffect, channel: str) -> dict[str, Parameter]:
        """An effect's parameters in a channel's unit, shares taken of the channel's `sd`."""
        longest = max(float(r.t[-1] - r.t[0]) for r in self.recordings)
        return effect.sized(self.sd(channel), self.simulator.channels[channel].unit, longest)

    def sd(self, channel: str) -> float:
        """Standard deviation of a channel over all recordings [its unit]; 1 where it is constant."""
        found = float(np.nanstd(np.concatenate([r[channel] for r in self.recordings])))
        return found if found > 0 else 1.0

    def largest(self, channel: str) -> float:
        """Largest absolute value of a channel in all recordings [its unit]."""
        return max(float(np.nanmax(np.abs(r[channel]))) for r in self.recordings)
