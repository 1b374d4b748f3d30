"""What every log has of its own, fitted along with every cause: when it was started, where a marker sat.

A simulator says so by `by_log`: `shift` (s, the log's clock against the simulator's) and `offset` (m, of the
point that is read against the body's origin, in the body's frame), each a Parameter.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from simgap.robot_effects.base import RobotEffect, Setting
from simgap.robot_effects.readout_pose import PLACE, TURN, rotated
from simgap.simulators.protocol import Channels, Parameter
from simgap.simulators.recording import Recording


def candidates(setting: Setting) -> list[RobotEffect]:
    """One for the shift, one for each pose's offset; none is a cause."""
    known: Mapping[str, Parameter] = getattr(setting.simulator, "by_log", {})
    logs, out = [r.name for r in setting.recordings], []
    if "shift" in known:
        out.append(_shift(logs, known["shift"], setting.compared()))
    if "offset" in known:
        out += [_offset(logs, known["offset"], body, c) for body, c in setting.poses().items()]
    return out


def _shift(logs: list[str], one: Parameter, columns: list[str]) -> RobotEffect:
    def shifted(window: Recording, channels: Channels, theta) -> Channels:
        since = window.t - window.t[0]
        return {n: np.interp(since - theta[window.name], since, channels[n]) for n in columns}

    says = "the log was started by hand, so much before the simulator"
    return RobotEffect("log.shift", says, dict.fromkeys(logs, one), alter=shifted, fitted=True, by_log=True)


def _offset(logs: list[str], one: Parameter, body: str, columns: Mapping[str, str]) -> RobotEffect:
    place, turn = [columns[a] for a in PLACE], [columns[a] for a in TURN]

    def moved(window: Recording, channels: Channels, theta) -> Channels:
        arm = np.array([theta[f"{window.name}.{a}"] for a in PLACE])
        by = rotated(np.array([channels[n] for n in turn]), arm)
        return {n: channels[n] + d for n, d in zip(place, by, strict=True)}

    each = {f"{log}.{a}": one for log in logs for a in PLACE}
    says = "where the marker sits on the body"
    return RobotEffect(f"log.{body}.offset", says, each, alter=moved, fitted=True, by_log=True)
