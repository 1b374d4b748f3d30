"""Features of trials drawn from the contact model itself, with planted parameters."""

from dataclasses import dataclass

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, subtasks
from hmmseg.contact.equations import Pads
from hmmseg.io.task import BlockTask, Move
from hmmseg.segmentation.emissions import Features

STACK = BlockTask(
    {"block1": "block2", "block2": "ground"}, (Move("block1", "ground"), Move("block2", "block1"))
)
STEPS = subtasks(STACK)
GRAVITY, COMPLIANCE, SQUEEZE = 9.81, 2e-4, 2.5e-4
PADS = Pads(SQUEEZE, SQUEEZE, 2 * COMPLIANCE, 2 * COMPLIANCE)


@dataclass(frozen=True)
class Planted:
    bias: tuple[float, ...] = (0.02, -0.03, 0.01, 0.0)
    weight: tuple[float, float] = (0.35, 0.55)
    width: tuple[float, float] = (0.016, 0.025)
    noise: float = 0.012


PLANTED = Planted()
LEVELS = {1: 0.022, 3: 0.008, 5: 0.006, 7: 0.02}


def planted(seed: int, planted: Planted = PLANTED, dt: float = 0.05):
    """Features and true subtask index (num_timesteps,) of one trial of two moves."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(14, 26, size=len(STEPS))
    labels = np.repeat(np.arange(len(STEPS)), lengths)
    num = labels.size
    force = np.array(planted.bias) + planted.noise * rng.normal(size=(num, 4))
    vx, vy, ay, y, d = (np.zeros(num) for _ in range(5))
    for s in STEPS:
        inside = np.flatnonzero(labels == s.index)
        m, noise = inside.size, lambda sd, m=inside.size: sd * rng.normal(size=m)
        if s.state == FREE:
            vx[inside], vy[inside] = rng.uniform(-0.2, 0.2, m), rng.uniform(-0.15, 0.15, m)
            y[inside], d[inside] = rng.uniform(0, 0.06, m), rng.uniform(0.03, 0.06, m)
            continue
        block = 0 if s.object == "block1" else 1
        grip = rng.uniform(1.5, 3.0, m)
        d[inside] = planted.width[block] - 2 * grip * SQUEEZE + noise(6e-5)
        if s.state == ABOVE_GROUND:
            ay[inside] = rng.normal(size=m)
            fy = planted.weight[block] * (1 + ay[inside] / GRAVITY)
            vx[inside], vy[inside] = rng.uniform(-0.2, 0.2, m), rng.uniform(-0.15, 0.15, m)
            y[inside] = rng.uniform(0.02, 0.06, m)
        else:
            assert s.state == ON_GROUND
            fy = rng.uniform(-0.8, 0.6 * planted.weight[block], m)
            vx[inside], vy[inside] = noise(2e-3), noise(2e-3)
            y[inside] = LEVELS[s.index] + fy * COMPLIANCE + noise(5e-5)
        force[inside] += np.stack([grip, fy / 2, -grip, fy / 2], axis=1)
    spans = {"vx": np.ptp(vx), "vy": np.ptp(vy), "y": np.ptp(y), "d": np.ptp(d), "force": 6.0, "press": 6.0}
    noises = {"sd_y": 5e-5, "sd_d": 6e-5, "sd_vx": 2e-3, "sd_vy": 2e-3}
    f = Features(
        t=np.arange(num) * dt, force=force, vx=vx, vy=vy, ay=ay, y=y, d=d,
        **{k: np.full(num, v) for k, v in noises.items()}, pads=PADS,
        gravity=GRAVITY, span={k: float(v) for k, v in spans.items()},
    )  # fmt: skip
    return f, labels
