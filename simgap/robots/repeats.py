"""Which logs are repeats of one motion.

A model's error is the same each time the same motion is made: twelve repeats tell of it what one does, and
only of the sensors' noise twelve times as much. Where a simulator is restarted in windows, each begins from a
state of its own; where it is not, logs to which it answers alike are repeats.
"""

from __future__ import annotations

import numpy as np

from simgap.robots.model import Composed
from simgap.simulators.protocol import Channels


def motions(composed: Composed) -> tuple[int, ...]:
    """A number for every log's motion: the same where the simulator answers the same to within the sensors'
    noise. None where it is restarted in windows."""
    logs = [w.log for w in composed.windows]
    if any(w.start is not None for w in composed.windows) or len({*logs}) < len(logs):
        return ()
    found: list[tuple[np.ndarray, Channels]] = []
    out = [-1] * len(composed.recordings)
    for window, answer in zip(composed.windows, composed.run({}), strict=True):
        t = composed.recordings[window.log].window(window.begin, window.end).t
        since = t - t[0]
        mine = None if answer is None else (since, answer)
        same = (k for k, other in enumerate(found) if mine and _alike(mine, other, composed.noise))
        out[window.log] = next(same, len(found))
        if out[window.log] == len(found):
            found.append(mine or (since, {}))
    return tuple(out)


def _alike(one: tuple[np.ndarray, Channels], other: tuple[np.ndarray, Channels], noise) -> bool:
    """Whether two answers, each by its times [s], differ by no more than the noise where both are."""
    (t, mine), (u, theirs) = one, other
    both = t <= min(t[-1], u[-1])
    if not theirs or both.sum() < 0.9 * max(t.size, u.size):
        return False
    apart = {n: v[both] - np.interp(t[both], u, theirs[n]) for n, v in mine.items()}
    return all(np.sqrt(np.mean(d**2)) <= noise[n] for n, d in apart.items())
