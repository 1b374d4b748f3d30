"""The hand of a rig.toml: tips from angles and back, written for the check alone.

Nothing here or in the rest of the generator comes from the packages that are being checked.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Stretch = float | np.ndarray
OUTWARD = (-1.0, 1.0)  # the left elbow points left, the right one right


@dataclass(frozen=True)
class Rig:
    """Numbers of a rig.toml: `bases`, `links` (2, 2) [m], pads [N/m], noise and sampling rate [Hz]."""

    bases: np.ndarray
    links: np.ndarray
    normal_stiffness: float
    shear_stiffness: float
    angle_noise: float
    velocity_noise: float
    force_noise: float
    rate: float
    gravity: float


def load_rig(path: Path) -> Rig:
    """Rig from its file."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    fingers = [table["fingers"]["1"], table["fingers"]["2"]]
    pad, noise = table["fingertip"], table["noise"]
    bases, links = (np.array([f[key] for f in fingers]) for key in ("base", "links"))
    return Rig(bases, links, pad["normal_stiffness"], pad["shear_stiffness"], noise["angle"],
               noise["velocity"], noise["force"], table["rate"], table["gravity"])  # fmt: skip


def angles(rig: Rig, tips: np.ndarray, stretch: Stretch = 0.0) -> np.ndarray:
    """Angles q11, q12, q21, q22 (n, 4) [rad] of tips x1, y1, x2, y2 (n, 4) [m].

    The elbow is where two circles meet; links are longer than the rig says by the share `stretch`, one
    for all or (2 fingers, 2 links).
    """
    out = np.empty_like(tips)
    for i in (0, 1):
        upper, lower = (rig.links * (1 + stretch))[i]
        way = tips[:, 2 * i : 2 * i + 2] - rig.bases[i]
        far = np.hypot(way[:, 0], way[:, 1])
        along = (far**2 + upper**2 - lower**2) / (2 * far)
        if (along**2 > upper**2).any():
            raise ValueError(f"finger {i + 1} cannot reach its path")
        beside = OUTWARD[i] * np.sqrt(upper**2 - along**2)
        unit = way / far[:, None]
        # Way points down, so that a left-hand normal of it points right.
        elbow = along[:, None] * unit + beside[:, None] * np.stack([-unit[:, 1], unit[:, 0]], 1)
        rest = way - elbow
        out[:, 2 * i] = np.arctan2(elbow[:, 1], elbow[:, 0])
        out[:, 2 * i + 1] = np.arctan2(rest[:, 1], rest[:, 0])
        # A link that points left would jump by a turn at -180 degrees.
        if i == 1:
            out[:, 3] = np.where(out[:, 3] > 0, out[:, 3] - 2 * np.pi, out[:, 3])
    return out


def tips(rig: Rig, q: np.ndarray) -> np.ndarray:
    """Tips (n, 4) [m] that the rig's links have at angles (n, 4) [rad]."""
    out = np.empty_like(q)
    for i in (0, 1):
        a, b = q[:, 2 * i], q[:, 2 * i + 1]
        out[:, 2 * i] = rig.bases[i, 0] + rig.links[i, 0] * np.cos(a) + rig.links[i, 1] * np.cos(b)
        out[:, 2 * i + 1] = rig.bases[i, 1] + rig.links[i, 0] * np.sin(a) + rig.links[i, 1] * np.sin(b)
    return out


def jacobians(rig: Rig, q: np.ndarray, stretch: Stretch = 0.0) -> np.ndarray:
    """Derivatives (n, 2 fingers, 2 axes, 2 joints) [m/rad] of tips by angles."""
    out = np.empty((len(q), 2, 2, 2))
    for i in (0, 1):
        for j in (0, 1):
            length = (rig.links * (1 + stretch))[i, j]
            out[:, i, 0, j] = -length * np.sin(q[:, 2 * i + j])
            out[:, i, 1, j] = length * np.cos(q[:, 2 * i + j])
    return out


def rates(rig: Rig, q: np.ndarray, velocity: np.ndarray, stretch: Stretch = 0.0) -> np.ndarray:
    """Angular rates (n, 4) [rad/s] at angles q of tips that move at `velocity` (n, 4) [m/s]."""
    jacobian = jacobians(rig, q, stretch)
    return np.linalg.solve(jacobian, velocity.reshape(-1, 2, 2)[..., None])[..., 0].reshape(-1, 4)
