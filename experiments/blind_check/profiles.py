"""How a hand gets from one place to another: shares of the way (0 to 1) over shares of the time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Profile = Callable[[np.ndarray], np.ndarray]


def minimum_jerk(rng: np.random.Generator) -> Profile:
    """Flash & Hogan, J. Neurosci. 5, 1985."""
    return _quintic


def _quintic(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return ((6 * s - 15) * s + 10) * s**3


def trapezoid(rng: np.random.Generator) -> Profile:
    """A machine's: constant acceleration, plateau, constant deceleration, of unequal shares."""
    rise, fall = rng.uniform(0.15, 0.4, 2)
    top = 1 / (1 - (rise + fall) / 2)

    def way(s: np.ndarray) -> np.ndarray:
        s = np.clip(s, 0, 1)
        up = top * s**2 / (2 * rise)
        along = top * (s - rise / 2)
        down = 1 - top * (1 - s) ** 2 / (2 * fall)
        return np.where(s < rise, up, np.where(s < 1 - fall, along, down))

    return way


def person(rng: np.random.Generator) -> Profile:
    """Skewed towards its start, with a later correction of what the first motion fell short or over.

    A lognormal speed (Plamondon, Biol. Cybern. 72, 1995) drawn to its end by a minimum-jerk correction
    (Flash & Henis, J. Cogn. Neurosci. 3, 1991).
    """
    skew, reach = rng.uniform(0.15, 0.45), rng.uniform(0.9, 1.03)
    late, lasting = rng.uniform(0.4, 0.55), rng.uniform(0.4, 0.45)

    def way(s: np.ndarray) -> np.ndarray:
        s = np.clip(s, 0, 1)
        first = _quintic(s ** (1 - skew / 2) / 0.9)
        return reach * first + (1 - reach) * _quintic((s - late) / lasting)

    return way


PROFILES: dict[str, Callable[[np.random.Generator], Profile]] = {
    "minimum_jerk": minimum_jerk,
    "trapezoid": trapezoid,
    "person": person,
}
