"""What a hand can reveal of what a task offers: a wrist sensor does not feel the grip."""

from __future__ import annotations

from dataclasses import replace

from hmmseg.contact.decompose import Decomposition, Evidence
from hmmseg.contact.identifiability import FRICTION, WIDTH
from hmmseg.hand.wrist import HIDDEN_GRIP
from hmmseg.io.rig import Rig

TOUCHED = "from the opening at which the pads touch, as what they give under the grip is not measured"


def revealed_by(found: Decomposition, rig: Rig) -> Decomposition:
    """The decomposition as this hand can carry it out: what it cannot reveal is without evidence.

    A fingertip hand reveals all; a gripper with a wrist sensor alone has the sum of both fingers' forces,
    which leaves weight, height and friction on a support as they are.
    """
    if rig.gripper is None or rig.gripper.grip_known:
        return found
    properties = {}
    for obj, entries in found.properties.items():
        kept = dict(entries)
        if FRICTION in kept:
            kept[FRICTION] = replace(kept[FRICTION], evidence=(), reason=HIDDEN_GRIP)
        if WIDTH in kept:
            evidence = tuple(_touched(each) for each in kept[WIDTH].evidence)
            kept[WIDTH] = replace(kept[WIDTH], evidence=evidence)
        properties[obj] = kept
    return replace(found, properties=properties)


def _touched(evidence: Evidence) -> Evidence:
    return evidence if evidence.condition else replace(evidence, condition=TOUCHED)
