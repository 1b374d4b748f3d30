"""What an identification remarks on: in warnings what is unlikely, in notes what a reader should know."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from estimation.compliance import unit_pads
from estimation.design import Design
from estimation.doubtful_pads import CERTAIN
from estimation.observations import CHANNELS
from hmmseg.io.plausibility import Finding, all_changed
from hmmseg.io.rig import FORCE_CHANNELS, Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.units import UNITS
from hmmseg.segmentation.align import AlignedTrials

STEEL = 7850.0  # physics: [kg/m^3]
DEEPEST = 10.0  # limit: depths of a block in widths; none is held by two pads that is deeper
LIGHT = 1500.0  # limit: [kg/m^3]: plastics and stone, of which the unit that makes it is the likeliest
NOT_LEVEL = 2e-3  # chosen: m; more than a tilted table or a slip in the grip make of a move on a level


def soft_pads(design: Design, rig: Rig) -> list[str]:
    """Pads that give otherwise than the rig says, as every grip shows while its force changes."""
    out, tip = [], unit_pads(rig)
    for kind, share, odds, compliance in (
        ("normal", design.doubt.normal, design.doubt.odds[0], tip.normal1),
        ("shear", design.doubt.shear, design.doubt.odds[1], tip.shear1),
    ):  # fmt: skip
        stated = getattr(rig.fingertip, f"{kind}_stiffness")
        if odds < CERTAIN:
            continue
        true = compliance * (share + (1.0 if np.isfinite(stated) else 0.0))
        seen = f"about {1 / true:.2g} N/m" if true > 0 else "no give at all, or forces that are late"
        out.append(
            f"[fingertip] {kind}_stiffness = {stated:g}, but readings within each grip show {seen}: "
            f"{'widths' if kind == 'normal' else 'heights'} allow for it"
        )
    return out


def unstated_pads(design: Design) -> list[str]:
    """Pads whose stiffness the rig leaves open: what is certain of them is what the recordings show."""
    doubt, props = design.doubt, {u.prop for u in design.unknowns}
    found = {
        "normal": ("width", doubt.normal, doubt.normal_give),
        "shear": ("height", doubt.shear, doubt.shear_give),
    }
    return [
        f"the rig states no [fingertip] {kind}_stiffness: {prop}s allow for pads that give as much as the "
        "readings within each grip leave open; with the stiffness measured they are surer"
        for kind, (prop, surprising, give) in found.items()
        if give and not surprising and prop in props
    ]


def unnamed(task: BlockTask, design: Design) -> list[str]:
    """Moves that should be level and are not: something that the task does not name lies beneath."""
    return [
        f"{task.performed[move].object} was {'raised' if rise > 0 else 'lowered'} by {abs(rise) * 1e3:.1f} "
        "mm, though the task moves it on a level: an object that the task does not name may lie beneath"
        for move, rise in design.level_rises.items()
        if abs(rise) > NOT_LEVEL
    ]


def misfits(aligned: AlignedTrials) -> list[str]:
    """What does not fit the task, trial by trial, and what was remarked on while aligning."""
    found = [trial.segmentation for trial in aligned.trials]
    remarks = dict.fromkeys(remark for s in found for remark in s.remarks)
    return [*(f"{s.file}: {failure}" for s in found for failure in s.failures), *remarks]


def dense(task: BlockTask, rig: Rig, found: Mapping[tuple[str, str], float]) -> list[str]:
    """Blocks too heavy for their size, of whatever they are made: forces in a smaller unit than N.

    `found`: means by (object, property) [N, m].
    """
    for obj in task.objects:
        weight, width = found.get((obj, "weight")), found.get((obj, "width"))
        if weight is None or width is None or width <= 0:
            continue
        height = found.get((obj, "height"), width)
        area = width * (height if height > 0 else width)
        depth = weight / (rig.gravity * STEEL * area)
        if depth < DEEPEST * width:
            continue
        density = weight / (rig.gravity * area**1.5)
        unit = min(("mN", "gf"), key=lambda name: abs(np.log(density * UNITS[name][1] / LIGHT)))
        names = rig.gripper.wrench[:3] if rig.gripper is not None else FORCE_CHANNELS
        remedy = Finding(names[0], "", all_changed(names, rig, unit=unit)).remedy
        return [
            f"{obj} weighs {weight:.3g} N at {width * 1e3:.3g} x {area / width * 1e3:.3g} mm: of steel it "
            f"would be {depth:.2g} m deep, so forces look like {unit}; expected {remedy}"
        ]
    return []


def unrepeated(design: Design) -> list[str]:
    """Where no grip repeats another, the prior alone says how far off the contact equations may be."""
    seen = np.bincount(design.channel, minlength=len(CHANNELS)) > 0
    alone = [name for name, n, s in zip(CHANNELS, design.repeats(), seen, strict=True) if s and n == 0]
    if not alone:
        return []
    return [
        f"no grip repeats another, so how far the model itself may be off in {', '.join(alone)} is taken "
        "from its prior; a second trial would show it"
    ]
