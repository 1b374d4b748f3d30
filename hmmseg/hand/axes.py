"""Two fingers whose x and y are exchanged: they grip from the sides, and stand apart there."""

from __future__ import annotations

import numpy as np

from hmmseg.hand.signals import task_space
from hmmseg.io.plausibility import Finding, exchanged
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.robust import white_sd

MORE = 3.0  # limit: a grip is so many times what pads share of a load unequally
CARTESIAN = ("{}1", "{}2", "v{}1", "v{}2")
FORCES = ("f{}1", "f{}2")


def check_axes(trial: Trial, rig: Rig) -> list[Finding]:
    """Fingers that press against each other, or stand apart, along y in place of x."""
    s = task_space(trial, rig)
    pressed = _strong(np.fmax(np.abs(s.fx1), np.abs(s.fx2))), _strong(s.fy1 - s.fy2)  # whatever signs of fx
    noise = max(_noise(s.fy1), _noise(s.fy2))
    forces = bool(pressed[1] > max(MORE * pressed[0], 20 * noise))
    gripping = np.abs(s.fy1 - s.fy2 if forces else s.fx1) > pressed[forces] / 2
    places = False
    if not rig.jointed and gripping.any():
        apart = [abs(float(np.nanmedian(v[gripping]))) if np.isfinite(v[gripping]).any() else 0.0
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
    """What a grip makes of a difference of forces (num_timesteps,) [N]."""
    there = np.abs(difference[np.isfinite(difference)])
    return float(np.quantile(there, 0.95)) if there.size else 0.0


def _noise(values: np.ndarray) -> float:
    there = values[np.isfinite(values)]
    return white_sd(there, 1) if there.size > 1 else 0.0
