"""A recorded performance once more: commands under which a hand moves and presses as it did.

What a healthy recording of just this operator would show, whatever its profile of speed, pace, grip and order
of fingers: no model of a person stands between. The tips follow the smoothed recorded motion; where they
touch, the command lies beyond it by what the recorded force takes (impedance control, as
`simgap.world.performance` has it).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask
from simgap.world.layout import standing_heights
from simgap.world.operator import Plan, Window
from simgap.world.performance import CONTROL_PERIOD
from simgap.world.properties import Blocks
from simgap.world.replay import TO_TIPS, finger_motion, places
from simgap.world.smoothing import smooth

# chosen: kg, N/m, damping ratio. Stiff, so that tips keep to the recorded motion; no stiffer, so that noise
# of positions makes little force through pads of any stiffness.
MASS, STIFFNESS, DAMPING = 0.1, 2000.0, 1.0
# numerics: sd of the commands' smoothing, in sample intervals: what wavers between samples is noise
BETWEEN = 0.5
QUICKEST = 0.01  # prior: s; the least of it: no hand commands more quickly
HEARD = 3.0  # chosen: sds of noise that a force must have to be one


def plan_again(
    signals: Signals, task: BlockTask, blocks: Blocks, boundaries: Sequence[float], force_sd: float
) -> Plan:
    """Commands for one performance as recorded, with its `boundaries` [s] between the subtasks.

    `force_sd` [N]: noise of one sample of force. ValueError where noise of positions is not known.
    """
    path = finger_motion(signals)
    if not np.isfinite(path.position).all():
        raise ValueError("motion that cannot be smoothed")
    start, duration = float(signals.t[0]), float(signals.t[-1] - signals.t[0])
    t = np.arange(round(duration / CONTROL_PERIOD) + 1) * CONTROL_PERIOD
    position = path.at(start + t)[0] @ TO_TIPS.T
    command = position + _load(signals, force_sd, start + t) / STIFFNESS
    blur = max(BETWEEN * float(np.median(np.diff(signals.t))), QUICKEST)
    command = gaussian_filter1d(command, blur / CONTROL_PERIOD, axis=0, mode="nearest")
    heights = standing_heights(task.initial, {name: blocks[name].height for name in task.objects})
    x = places(signals, path, task, np.asarray(boundaries))
    windows = _windows(task, np.asarray(boundaries) - start)
    damping = 2 * DAMPING * np.sqrt(MASS * STIFFNESS)
    where = {name: (x[name], heights[name]) for name in task.objects}
    return Plan(command, (MASS, STIFFNESS, damping), where, windows, duration)


def _load(signals: Signals, sd: float, t: np.ndarray) -> np.ndarray:
    """Smoothed forces (len(t), 4) of the tips x1, y1, x2, y2 [N]; none where only noise is."""
    force = np.stack([signals.fx1, signals.fy1, signals.fx2, signals.fy2], 1)
    unknown, noise = np.full_like(force, np.nan), np.full_like(force, sd)
    smoothed = smooth(signals.t, force, unknown, noise, noise)
    load = np.where(np.abs(smoothed.position) > HEARD * smoothed.sd, smoothed.position, 0.0)
    return np.stack([np.interp(t, signals.t, column) for column in load.T], 1)


def _windows(task: BlockTask, boundaries: np.ndarray) -> tuple[Window, ...]:
    """When the moves were commanded, from the four boundaries [s] of each."""
    out, before = [], 0.0
    for k, move in enumerate(task.performed):
        touch, leave, meet, part = boundaries[4 * k : 4 * k + 4]
        out.append(Window(move.object, move.slide, before, (touch + leave) / 2, (leave + meet) / 2,
                          (meet + part) / 2, part + (part - meet) / 2))  # fmt: skip
        before = part
    return tuple(out)
