"""Forces in other units than N, which nothing in mechanics tells: load and inertia scale alike.

What tells is what is known apart: the noise of the sensor where `rig.toml` states it, what grippers weigh.
"""

from __future__ import annotations

import numpy as np

from hmmseg.hand.tool import Tool
from hmmseg.io.plausibility import Finding, all_changed, check_forces
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.trial import Trial
from hmmseg.io.units import UNITS

NEAR = 0.3  # limit: relative; noise is stated to within so much, and units differ by factors of 4 and more
LIGHTEST, HEAVIEST = 0.08, 30.0  # limit: [kg] of a gripper with what hangs below its sensor
USUAL = 1.0  # limit: [kg] of one
WHITE = -0.5  # limit: -0.56 and less is white noise, -0.42 and more what filters leave that make it a tenth
STRETCH = 25  # numerics: samples
FORCES = ("mN", "gf", "kgf", "kN")


def check_noise(trial: Trial, rig: Rig) -> list[Finding]:
    """Forces of fingertips whose noise is that of the rig times the size of another unit."""
    names = [name for name in FORCE_CHANNELS if name in trial.channels]
    if rig.noise.force is None or not names or check_forces(trial, rig):
        return []
    shown = noise_of([trial.channels[name] for name in names])
    unit, off = _nearest(rig.noise.force / shown) if shown > 0 else ("", np.inf)
    if off > NEAR or (UNITS[unit][1] > 1 and whiteness([trial.channels[name] for name in names]) > WHITE):
        return []  # a filter makes noise smaller, too, but neighbours alike
    stated = f"where [noise] force = {rig.noise.force:g} N in rig.toml"
    problem = f"has noise of {shown:.2g} {stated}: it looks like {unit}"
    return [Finding(names[0], problem, all_changed(names, rig, unit=unit), certain=False)]


def tool_warnings(trial: Trial, rig: Rig, tool: Tool) -> tuple[str, ...]:
    """A line where the tool's inertia is none of a gripper's, or another unit's times the stated one."""
    gripper = rig.gripper
    assert gripper is not None
    found = abs(tool.inertia)
    stated = gripper.tool_mass
    if stated is None and LIGHTEST < found < HEAVIEST:
        return ()
    if stated is not None and _nearest(stated / found)[1] > np.log(2):
        return ()
    unit, _ = _nearest((USUAL if stated is None else stated) / found)
    expected = f"{LIGHTEST:g} to {HEAVIEST:g} kg" if stated is None else f"{stated:g} kg in rig.toml"
    names = gripper.wrench[:3]
    finding = Finding(names[0], "", all_changed(names, rig, unit=unit))
    text = f"move a tool of {found:.3g} kg ({expected}): they look like {unit}"
    return (f"{trial.file}: columns {', '.join(names)} {text}; expected {finding.remedy}",)


def _nearest(size: float) -> tuple[str, float]:
    """The unit of force nearest to a size [N], and how far it is off (logarithm)."""
    off = {unit: abs(float(np.log(size / UNITS[unit][1]))) for unit in FORCES}
    unit = min(off, key=lambda name: off[name])
    return unit, off[unit]


def _quiet(channels: list[np.ndarray]) -> list[np.ndarray]:
    """Second differences of the quietest quarter of stretches, as contacts are no noise."""
    every = [v[np.isfinite(v)] for v in channels]
    pieces = [
        np.diff(p, 2) for v in every for p in np.array_split(v, max(1, v.size // STRETCH)) if p.size > 2
    ]
    pieces.sort(key=lambda piece: float(piece @ piece) / piece.size)
    return pieces[: max(1, len(pieces) // 4)]


def whiteness(channels: list[np.ndarray]) -> float:
    """Correlation of neighbouring second differences of noise, -2/3 where it is white."""
    pieces = _quiet(channels)
    total = sum(float(piece @ piece) for piece in pieces)
    return sum(float(piece[1:] @ piece[:-1]) for piece in pieces) / total if total > 0 else 0.0


def noise_of(channels: list[np.ndarray]) -> float:
    """Standard deviation of one sample's noise: that of the stretch at the end of the quiet quarter."""
    pieces = _quiet(channels)
    return float(np.sqrt(np.mean(pieces[-1] ** 2) / 6)) if pieces else 0.0
