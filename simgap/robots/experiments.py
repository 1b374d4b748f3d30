"""The next experiment: of the motions that the robot has run, the one that tells a set apart best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simgap.robots.search import Search, Settled
from simgap.robots.verdict import RobotVerdict


@dataclass(frozen=True)
class NextLog:
    """A log whose motion is to be repeated, the effects it separates, and what it is expected to gain."""

    log: str
    separates: tuple[str, ...]
    gain: float


def next_log(search: Search, best: Settled, verdict: RobotVerdict) -> NextLog | None:
    """For a set: of the sets that were fitted with one of its members each, the log along which the closest
    two differ most, whitened.

    None where nothing is to be separated, or no motion is expected to gain a nat.
    """
    if verdict.verdict != "set":
        return None
    logs = search.composed.recordings
    gains, smallest = np.zeros(len(logs)), np.inf
    for one in search.known.values():
        if not {*one.names} & {*verdict.indistinguishable}:
            continue
        apart = best.whiten(np.nan_to_num(best.linear.residual - one.linear.residual))
        each = 0.5 * np.bincount(best.linear.rows.log, apart**2, len(logs))
        if each.sum() < smallest:
            smallest, gains = float(each.sum()), each
    at = int(gains.argmax())
    if gains[at] < 1.0:
        return None
    return NextLog(logs[at].name, (*verdict.causes, *verdict.indistinguishable), float(gains[at]))
