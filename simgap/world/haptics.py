"""Passivity of a haptic loop: an observer of the port's energy and a controller that damps.

The device holds each rendered force for a whole period, and the force is a sample old: a stiff
virtual contact then returns more energy than it took. Port energy is counted exactly, as held
force times displacement, and whatever was returned too much is dissipated at once by damping
(passivity observer and controller: Hannaford & Ryu, IEEE Trans. Robotics Autom. 18, 2002).
"""

from __future__ import annotations

import numpy as np


def stiffest_passive(damping: float, period: float, delay: float) -> float:
    """Stiffness [N/m] up to which a sampled spring on a damped device is passive without control.

    damping > stiffness (period / 2 + delay), the sampled-data condition of Colgate & Schenkel,
    J. Robotic Systems 14 (1997), with the computation's delay [s] added to the hold's half period;
    `damping` [N s/m] is the device's own.
    """
    return damping / (period / 2 + delay)


class PassivityControl:
    """Keeps what a virtual scene returns through the fingers below what it took.

    Call `render` once a period with what the model asks for. `energy` [J] is what the scene has
    taken up through the port so far; `allowed` [J] is what it may return beyond that (what blocks
    and springs held at the start).
    """

    def __init__(self, period: float, allowed: float = 0.0, limit: float = 50.0) -> None:
        self.period, self.allowed, self.limit = period, allowed, limit
        self.energy = 0.0
        self._held, self._moved = np.zeros(4), np.zeros(4)
        self._place: np.ndarray | None = None

    def render(self, force: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Force (2, 2) [N] on the scene to hold for the next period; the device feels its opposite.

        `force` (2, 2) [N] is the model's, `position` (2, 2) [m] the fingers' now. Damping brakes
        with at most `limit` [N s/m], the device's own bound, beyond cancelling a push.
        """
        here = np.reshape(position, 4)
        moved = np.zeros(4) if self._place is None else here - self._place
        coming = 2 * moved - self._moved  # the fingers' next displacement if they keep accelerating
        self._place, self._moved = here.copy(), moved
        self.energy += float(self._held @ moved)
        out = np.reshape(force, 4).astype(float)
        expected = self.energy + float(out @ coming) + self.allowed
        travel = float(coming @ coming)
        if expected < 0.0 and travel > 0.0:
            # Up to the device's own bound, or as much as takes away the push along the motion.
            most = max(self.limit / self.period, -float(out @ coming) / travel)
            out = out + min(-expected / travel, most) * coming
        self._held = out
        return out.reshape(2, 2)
