"""The crossing quantity of each contact change, from fingertip signals and a fitted alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, Subtask
from hmmseg.contact.equations import Pads, block_y, hanging, pads_of
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.boundaries import POINTS, Crossing, crossing_density, first_of
from hmmseg.segmentation.emissions import Parameters
from hmmseg.segmentation.features import noise_sd

NEAREST = 6  # samples of a hold that locate the block next to a contact change


@dataclass(frozen=True)
class Contacts:
    """Fingertip signals of one trial with what the fit knows: biases, weights and spans.

    `compression` (2, T): each finger's pad compression by its force [m]; `inward` (2, T): its
    position along its own closing direction [m], `inward_velocity` likewise; `deflection` (T,):
    the pads' mean shear deflection by the net vertical force [m].
    """

    signals: Signals
    pads: Pads
    compression: np.ndarray
    inward: np.ndarray
    inward_velocity: np.ndarray
    deflection: np.ndarray
    weight: dict[str, float]
    sd: dict[str, float]

    def density(self, before: Subtask, after: Subtask, n: int, held: slice) -> np.ndarray | None:
        """Density (POINTS,) of the boundary in the interval n, n+1; None: nothing is known.

        `held`: samples at which, on the held side of the boundary, the block rests or is held.
        """
        width = float(self.signals.t[n + 1] - self.signals.t[n])
        if before.state == FREE:
            return self._checked(crossing_density, [self._gap(i, n, held, 1) for i in (0, 1)], width)
        if after.state == FREE:
            return self._checked(first_of, [self._gap(i, n, held, -1) for i in (0, 1)], width)
        if {before.state, after.state} == {ON_GROUND, ABOVE_GROUND}:
            lifting = after.state == ABOVE_GROUND
            return self._checked(crossing_density, [self._load(before, n, held, lifting)], width)
        return None

    @staticmethod
    def _checked(combined, crossings: list[Crossing], width: float) -> np.ndarray | None:
        if not all(c.known for c in crossings):
            return None
        density = combined(crossings, width)
        return density if density.shape == (POINTS,) and np.isfinite(density).all() else None

    def _gap(self, i: int, n: int, held: slice, sign: int) -> Crossing:
        """Compression of finger i's pad: rises through zero at a touch, falls at a release.

        On the held side the force gives it; on the free side the distance to the block's face.
        """
        face = _median(self.inward[i, held] - self.compression[i, held])
        free, touching = (n, n + 1) if sign > 0 else (n + 1, n)
        gap = self.inward[i, free] - face
        squeeze, sd_squeeze = self.compression[i, touching], self.sd["compression"]
        if self.pads.normal1 == 0.0:  # a rigid pad hides its compression
            squeeze = max(self.inward[i, touching] - face, 0.0)
            sd_squeeze = self.sd["inward"] + 0.5 * abs(gap)
        v, sd_v = self.inward_velocity[i], self.sd["inward_velocity"]
        if sign > 0:
            return Crossing(gap, squeeze, v[n], v[n + 1], self.sd["inward"], sd_squeeze, sd_v, "impact")
        return Crossing(-squeeze, -gap, -v[n], -v[n + 1], sd_squeeze, self.sd["inward"], sd_v, "smooth")

    def _load(self, before: Subtask, n: int, held: slice, lifting: bool) -> Crossing:
        """Height of the fingers above where the pads' shear just carries the weight."""
        y = self.signals.y
        level = _median(y[held] - self.deflection[held])
        carrying = hanging(self.weight[str(before.object)], self.pads)
        resting, lifted = (n, n + 1) if lifting else (n + 1, n)
        on_ground = self.deflection[resting] - carrying
        sd_ground = self.sd["deflection"]
        if hanging(1.0, self.pads) == 0.0:  # rigid pads: only the position tells
            on_ground, sd_ground = y[resting] - level, self.sd["y"]
        in_air = y[lifted] - level - carrying
        v, sd_y, sd_v = self.signals.vy, self.sd["y"], self.sd["vy"]
        if lifting:
            return Crossing(on_ground, in_air, v[n], v[n + 1], sd_ground, sd_y, sd_v, "launch")
        return Crossing(-in_air, -on_ground, -v[n], -v[n + 1], sd_y, sd_ground, sd_v, "impact")


def _median(values: np.ndarray) -> float:
    """Median of the values that are there, NaN of none."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else np.nan


def contacts(signals: Signals, rig: Rig, parameters: Parameters) -> Contacts:
    """Contacts of one trial; noise the rig does not state is learned from the recording."""
    s, bias, root2 = signals, parameters.bias, np.sqrt(2.0)
    normal = np.stack([s.fx1 - bias[0], -(s.fx2 - bias[2])])
    inward = np.stack([s.x1, -s.x2])
    velocity = np.stack([s.vx1, -s.vx2])
    force = parameters.scale["force"] if np.isnan(s.sd_force) else s.sd_force

    def sd(stated: np.ndarray, values: np.ndarray) -> float:
        return float(np.nanmedian(stated)) if np.isfinite(stated).any() else noise_sd(values)

    pads = pads_of(rig)
    fy1, fy2 = s.fy1 - bias[1], s.fy2 - bias[3]
    level = parameters.scale["level"]
    return Contacts(
        signals=s, pads=pads, compression=normal * pads.normal1, inward=inward,
        inward_velocity=velocity, deflection=-block_y(0.0, fy1, fy2, pads), weight=parameters.weight,
        sd={
            "compression": force * pads.normal1 + 1e-9,
            "inward": sd(s.sd_x, s.x1),
            "inward_velocity": sd(s.sd_vx, s.vx1),
            "y": float(np.hypot(sd(s.sd_y, s.y1) / root2, level)),
            "vy": sd(s.sd_vy, s.vy1) / root2,
            "deflection": root2 * hanging(force, pads) + 1e-9,
        },
    )  # fmt: skip
