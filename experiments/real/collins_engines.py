"""Four engines' recordings of an arm that pushes a cube beside the real ones: distances by phase and channel.

One trial an engine, for its repeats are byte-identical, and what one trial scatters by is not known: so this
is no verdict. All trials count from when their hand leaves its place, hand and cube from where they were.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.real.collins_hand import BEGINS, PHASES, left

ENGINES = ("Mujoco", "PyBullet", "VRepBullet283", "VRepVortex")
PLACES = tuple(f"{body}_{a}" for body in ("ee", "cube") for a in "xyz")
LAST = 17.0  # s since the hand left its place: the latest that every real trial has
RATE = 20.0  # Hz
SETTLED = 0.2  # s that the cameras take


def since_left(frame: pd.DataFrame) -> tuple[np.ndarray, float]:
    """Places (n, 6) of hand and cube every 1 / RATE s since the hand left its place, less where they were
    then; and by which angle [deg] the cube has turned at the end."""
    t, values = frame.t.to_numpy(), frame[list(PLACES)].to_numpy()
    values = values - values[0]
    times = left(t, values[:, :3].T) + np.arange(0.0, LAST, 1 / RATE)
    turn = frame[["cube_qw", "cube_qx", "cube_qy", "cube_qz"]].to_numpy()
    angle = 2 * np.arccos(min(1.0, abs(float(turn[0] @ turn[-1]))))
    return np.array([np.interp(times, t, v) for v in values.T]).T, float(np.degrees(angle))


def beside(folder: Path) -> dict[str, Any]:
    """Of each engine its root mean square distance from the mean of the real trials by phase and channel
    [mm], and where the cube ends; of the real trials their scatter about that mean."""
    frames: list[Any] = [pd.read_csv(p) for p in sorted((folder / "cubepush" / "real").glob("real_*.csv"))]
    real = [since_left(f[f.t >= SETTLED].reset_index(drop=True)) for f in frames]
    places = np.array([p for p, _ in real])
    mean = places.mean(0)
    scatter = np.sqrt(np.sum((places - mean) ** 2, 0) / (len(real) - 1))
    out = {"scatter of real": _entry(scatter, places[:, -1, 3:], [a for _, a in real])}
    for name in ENGINES:
        place, turned = since_left(pd.read_csv(folder / "cubepush" / "sim" / f"{name}.csv"))
        out[name] = _entry(place - mean, place[None, -1, 3:], [turned])
    return out


def _entry(off: np.ndarray, end: np.ndarray, turned: list[float]) -> dict[str, Any]:
    """Of distances (n, 6), cubes' ends (k, 3) and how far they turned (k)."""
    edges = [0, *np.searchsorted(np.arange(len(off)) / RATE, BEGINS[1:]), len(off)]
    parts = {
        phase: dict(zip(PLACES, (1e3 * np.sqrt(np.mean(off[a:b] ** 2, 0))).round(2).tolist(), strict=True))
        for phase, a, b in zip(PHASES, edges, edges[1:], strict=False)
    }
    return {
        "rms_mm": parts,
        "cube_end_mm": (1e3 * end.mean(0)).round(1).tolist(),
        "cube_turned_deg": round(float(np.mean(turned)), 1),
    }
