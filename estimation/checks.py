"""Evidence against an identification: posterior-predictive checks, and remarks for the reader.

For each channel the discrepancy is the weighted scatter of the grips' means about their prediction, with the
scatter between grips at its prior median (it may not absorb what is checked): its posterior-predictive
p-value compares observed with replicated scatter (Gelman, Meng, Stern 1996). A small p-value means that grips
differ by more than sensors and hand explain.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation import priors
from estimation.design import Design
from estimation.observations import CHANNELS
from estimation.pads import unit_pads
from estimation.posterior import NUM_CHANNELS, Posterior
from estimation.sampler import Draws
from hmmseg.hand.plausibility import Finding, changed
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.units import UNITS
from hmmseg.levels import CERTAIN, MOVED
from hmmseg.numbers import plain
from hmmseg.segmentation.align import AlignedTrials

NUM_REPLICATES = 400  # numerics: determine a p-value of SMALL to 0.003
SMALL = (1 - CERTAIN) / len(CHANNELS)  # p-value below which a check warns: rare in a healthy recording
MEANING = {
    "force": "the net vertical force while carried differs between grips",
    "distance": "the distance of the fingers while held differs between grips",
    "rise": "the height by which a block rises or sinks differs between trials (slip in the grip does that)",
}


@dataclass(frozen=True)
class PredictiveCheck:
    """Posterior-predictive p-value per channel, and warnings for small ones."""

    p_values: dict[str, float]
    excess: dict[str, float]  # sd between grips beyond the sensors' noise, posterior median [N, m, m]
    repeats: dict[str, int]  # observations that determine it, 0 if only the prior does
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """p-values, excess scatter and number of repeats, by channel."""
        return {
            name: {"p_value": p, "scatter_between_grips": self.excess[name], "repeats": self.repeats[name]}
            for name, p in self.p_values.items()
        }


def check(post: Posterior, draws: Draws, rng: np.random.Generator) -> PredictiveCheck:
    """Check every channel that was observed."""
    d = post.design

    def of(values: np.ndarray) -> np.ndarray:
        return values.reshape(len(draws.flat), values.shape[-1])[chosen]

    chosen = rng.integers(len(draws.flat), size=NUM_REPLICATES)
    scales, shares = of(draws.scales), of(draws.shares)
    predicted = of(draws.chain) @ d.coefficients.T + of(draws.deviations) @ d.shifts.T
    predicted += shares[:, d.channel] * d.unit
    variance = d.variance * np.exp(2 * scales[:, d.channel])
    variance += (priors.SCATTER_MEDIAN[d.channel] * d.unit) ** 2
    z = (d.mean - predicted) / np.sqrt(variance)
    new = rng.normal(size=z.shape)
    p_values, excess, repeats, warnings = {}, {}, {}, list[str]()
    for c, name in enumerate(CHANNELS):
        mine = (d.channel == c) & ~d.slope
        if not mine.any():
            continue
        observed, replicated = ((v[:, mine] ** 2).sum(axis=1) for v in (z, new))
        p_values[name] = float(np.mean(replicated >= observed))
        share = priors.SCATTER_MEDIAN[c] * np.exp(scales[:, NUM_CHANNELS + c])
        excess[name] = float(np.median(share) * np.mean(np.abs(d.unit[mine])))
        repeats[name] = int(d.repeats()[c])
        if p_values[name] < SMALL:
            size = f"{excess[name]:.2g} N" if c == 0 else f"{1e6 * excess[name]:.2g} um"
            warnings.append(f"{MEANING[name]} by {size} beyond sensor noise; intervals allow for it")
    return PredictiveCheck(p_values, excess, repeats, tuple(warnings))


STEEL = 7850.0  # physics: [kg/m^3]
DEEPEST = 10.0  # limit: depth of a block in widths; two pads hold none that is deeper
LIGHT = 1500.0  # limit: [kg/m^3]; a usual density, to which the likeliest unit of forces leads


def soft_pads(design: Design, rig: Rig) -> list[str]:
    """Pads whose stiffness differs from the rig's, as grips show while their force changes."""
    out, pads = [], unit_pads(rig)
    for prop, (kind, doubt) in zip(("widths", "heights"), design.doubts.items(), strict=True):
        stated = getattr(rig.fingertip, f"{kind}_stiffness")
        if doubt.odds < CERTAIN:
            continue
        true = getattr(pads, f"{kind}1") * (doubt.share + (1.0 if np.isfinite(stated) else 0.0))
        seen = f"about {plain(1 / true)} N/m" if true > 0 else "no give at all, or forces that are late"
        said = f"{kind}_stiffness {f'= {stated:g}' if np.isfinite(stated) else 'is not finite'}"
        out.append(f"[fingertip] {said}, but readings within each grip show {seen}: {prop} allow for it")
    return out


def unstated_pads(design: Design) -> list[str]:
    """Pads whose stiffness the rig leaves open."""
    props = {u.prop for u in design.unknowns}
    return [
        f"the rig states no [fingertip] {kind}_stiffness: {prop}s allow for pads that give as much as the "
        "readings within each grip leave open; with the stiffness measured they are surer"
        for prop, (kind, doubt) in zip(("width", "height"), design.doubts.items(), strict=True)
        if doubt.give and not doubt.share and prop in props
    ]


def unnamed(task: BlockTask, design: Design) -> list[str]:
    """Moves that should be level and are not: an unnamed object lies beneath."""
    return [
        f"{task.performed[move].object} was {'raised' if rise > 0 else 'lowered'} by {abs(rise) * 1e3:.1f} "
        "mm, though the task moves it on a level: an object that the task does not name may lie beneath"
        for move, rise in design.level_rises.items()
        if abs(rise) > MOVED
    ]


def misfits(aligned: AlignedTrials) -> list[str]:
    """What does not fit the task, trial by trial, and the remarks of the alignment."""
    remarks = dict.fromkeys(remark for s in aligned.segmentations for remark in s.remarks)
    return [*(f"{s.file}: {failure}" for s in aligned.segmentations for failure in s.failures), *remarks]


def dense(task: BlockTask, rig: Rig, found: Mapping[tuple[str, str], float]) -> list[str]:
    """Blocks too heavy for their size in any material, as in a smaller unit than N; `found`: means [N, m]."""
    for obj in task.objects:
        weight, width = (found.get((obj, prop), 0.0) for prop in ("weight", "width"))
        height = found.get((obj, "height"), width)
        area = width * (height if height > 0 else width)
        if width <= 0 or weight < DEEPEST * width * rig.gravity * STEEL * area or weight == 0:
            continue
        depth = weight / (rig.gravity * STEEL * area)
        density = weight / (rig.gravity * area**1.5)
        unit = min(("mN", "gf"), key=lambda name: abs(np.log(density * UNITS[name][1] / LIGHT)))
        names = rig.gripper.wrench[:3] if rig.gripper is not None else FORCE_CHANNELS
        remedy = Finding(names[0], "", changed(names, rig, unit=unit)).remedy
        return [
            f"{obj} weighs {weight:.3g} N at {width * 1e3:.3g} x {area / width * 1e3:.3g} mm: of steel it "
            f"would be {depth:.2g} m deep, so forces look like {unit}; expected {remedy}"
        ]
    return []


def unrepeated(design: Design) -> list[str]:
    """Channels without repeated grips, whose model error rests on the prior alone."""
    seen = np.bincount(design.channel, minlength=len(CHANNELS)) > 0
    alone = [name for name, n, s in zip(CHANNELS, design.repeats(), seen, strict=True) if s and n == 0]
    if not alone:
        return []
    return [f"no grip repeats another, so how far the model itself may be off in {', '.join(alone)} is taken "
            "from its prior; a second trial would show it"]  # fmt: skip


def unchecked(design: Design, rig: Rig) -> list[str]:
    """Errors of the rig that no recording would contradict."""
    if not rig.jointed or not any(u.prop == "width" for u in design.unknowns):
        return []
    return [
        "widths take the distance of the fingers' bases from rig.toml, and bases that stand closer than it "
        "says would not show; a block of known width would check it"
    ]
