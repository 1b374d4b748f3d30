"""What the hand's sensors record of a true motion: samples at a rate, with the rig's noise."""

from __future__ import annotations

import numpy as np

from hmmseg.hand.kinematics import inverse, joint_velocity, require_reach
from hmmseg.io.rig import Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS, Trial

DEFAULT_RATE = 20.0  # cited: Hz, the paper's
# chosen: standard deviations of one sample where a rig leaves them to be learned
# prior: rad, m, rad/s, N
DEFAULT_NOISE = {"angle": 2e-4, "position": 3e-5, "velocity": 0.03, "force": 0.012}
DEFAULT_CARTESIAN_VELOCITY = 0.004  # prior: m/s


def record(t: np.ndarray, position: np.ndarray, velocity: np.ndarray, force: np.ndarray, rig: Rig,
           rng: np.random.Generator | None, file: str) -> Trial:  # fmt: skip
    """Trial sampled at times t (num_timesteps,) from tips (num_timesteps, 2 fingers, 2 axes).

    Positions [m], velocities [m/s], forces [N] on the environment. Noise of the rig from `rng`,
    none where that is None. InputError where a tip is out of the hand's reach.
    """
    channels: dict[str, np.ndarray] = {}
    for i in (1, 2):
        place, speed = position[:, i - 1], velocity[:, i - 1]
        if rig.jointed:
            finger = rig.finger(i)
            require_reach(finger, i, place)
            angles = inverse(finger, i, place)
            rates = joint_velocity(finger, angles, speed)
            for k in (0, 1):
                channels[f"q{i}{k + 1}"] = _noisy(angles[:, k], rig, "angle", rng)
                channels[f"dq{i}{k + 1}"] = _noisy(rates[:, k], rig, "velocity", rng)
        else:
            for k, axis in enumerate("xy"):
                channels[f"{axis}{i}"] = _noisy(place[:, k], rig, "position", rng)
                channels[f"v{axis}{i}"] = _noisy(speed[:, k], rig, "velocity", rng)
        for k, axis in enumerate("xy"):
            channels[f"f{axis}{i}"] = _noisy(force[:, i - 1, k], rig, "force", rng)
    order = JOINT_CHANNELS if rig.jointed else CARTESIAN_CHANNELS
    return Trial(file, t, {name: channels[name] for name in order})


def noise_sd(rig: Rig, quantity: str) -> float:
    """Standard deviation of one sample of `angle`, `position`, `velocity` or `force`."""
    value = getattr(rig.noise, quantity)
    if value is not None:
        return value
    if quantity == "velocity" and not rig.jointed:
        return DEFAULT_CARTESIAN_VELOCITY
    return DEFAULT_NOISE[quantity]


def _noisy(values: np.ndarray, rig: Rig, quantity: str, rng: np.random.Generator | None) -> np.ndarray:
    return values if rng is None else values + noise_sd(rig, quantity) * rng.standard_normal(values.shape)
