"""The demo's hand as a gripper in Cartesian space that rolls while it carries, by a planted angle."""

from dataclasses import replace

import numpy as np

from experiments.worlds import WORLDS, trials_of
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Noise, Rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, ROLL, Trial

FLATTENS = 0.03  # s in which a block that landed on its corner comes to lie flat, and the hand with it


def rolling_trial(number: int, angle: float, world: str = "50 Hz") -> tuple[Trial, Rig, np.ndarray]:
    """A simulated trial with hand and block rolled by up to `angle` [rad] in carries, rig, boundaries [s].

    The roll grows from lift to landing. The hand is higher by what the corner hangs lower, so that the
    landing is when it was. Its roll stands in the column `hand_roll`, which may be left out.
    """
    (judged,) = trials_of(WORLDS[world], [number])
    s, b = task_space(judged.trial, judged.rig), judged.boundaries
    roll = np.zeros(s.t.size)
    for lift, land in b.reshape(-1, 4)[:, 1:3]:
        share = np.clip((s.t - lift) / (land - lift), 0, 1)
        growing = share**2 * (3 - 2 * share) * (s.t <= land)
        roll += angle * (growing + np.exp(-np.maximum(s.t - land, 0) / FLATTENS) * (s.t > land))
        angle = -angle  # the other way round with the next block
    width = float(np.median(s.distance[(s.t > b[0]) & (s.t < b[3])]))
    c = {name: getattr(s, name).copy() for name in CARTESIAN_CHANNELS}
    higher = width / 2 * np.abs(np.sin(roll))
    cos, sin = np.cos(roll), np.sin(roll)
    pace = np.gradient(roll, s.t)
    for kind in "f", "v", "":
        x, y = (c[f"{kind}{a}2"] - c[f"{kind}{a}1"] for a in "xy")
        dx, dy = x * cos - y * sin, x * sin + y * cos
        if kind == "v":
            dx, dy = dx - pace * s.distance * sin, dy + pace * s.distance * cos
        for a, new in zip("xy", (dx, dy), strict=True):
            mean = (c[f"{kind}{a}1"] + c[f"{kind}{a}2"]) / 2
            mean = mean + (a == "y") * {"": higher, "v": np.gradient(higher, s.t), "f": 0.0}[kind]
            c[f"{kind}{a}1"], c[f"{kind}{a}2"] = mean - new / 2, mean + new / 2
    sd_x, sd_y, sd_v = (float(np.median(v)) * np.sqrt(2) for v in (s.sd_x, s.sd_y, s.sd_vx))
    noise = Noise(
        position=float(np.hypot(sd_x, sd_y) / np.sqrt(2)), velocity=sd_v, force=judged.rig.noise.force
    )
    rig = Rig(rate=judged.rig.rate, gravity=judged.rig.gravity, fingertip=judged.rig.fingertip, noise=noise)
    return replace(judged.trial, channels=c | {ROLL: roll}), rig, b
